"""Advisories in the OSV format, read from files: versions of a package with a known vulnerability.

Source: Open Source Vulnerability format 1.6, "affected" and "evaluation algorithm"
(https://ossf.github.io/osv-schema/). PyPI's advisories in this form: https://github.com/pypa/advisory-database.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

_FILE_MAX_BYTES = 256 << 20
_KINDS = ("introduced", "last_affected", "fixed")


class AdvisoryError(Exception):
    """File without valid advisories; the text names it."""


def read_advisories(path: Path) -> list[Mapping[str, Any]]:
    """Return the advisories of a file (one, a list, or one a line) or a folder's files, but for withdrawn ones.

    Raises ``AdvisoryError``: a file cannot be read, or is something else.
    """
    files = sorted(path.rglob("*.json")) if path.is_dir() else [path]
    found = [each for file in files for each in _of_file(file)]
    if not found:
        raise AdvisoryError(f"{path}: no advisory in the form of OSV")
    return [each for each in found if not each.get("withdrawn")]


def is_affected(advisory: Mapping[str, Any], name: str, version: str) -> bool:
    """Return whether a version of a PyPI package is one that the advisory names or spans.

    A version that PEP 440 does not allow is compared by its text alone.
    """
    for affected in advisory.get("affected", ()):
        package = affected.get("package", {})
        if package.get("ecosystem") != "PyPI" or canonicalize_name(package.get("name", "")) != canonicalize_name(name):
            continue
        if any(same_version(version, each) for each in affected.get("versions", ())):
            return True
        ranges = [each for each in affected.get("ranges", ()) if each.get("type") == "ECOSYSTEM"]
        if any(_spans(each.get("events", ()), version) for each in ranges):
            return True
    return False


def _of_file(path: Path) -> Iterator[Mapping[str, Any]]:
    try:
        if path.stat().st_size > _FILE_MAX_BYTES:
            raise AdvisoryError(f"{path}: longer than {_FILE_MAX_BYTES} bytes")
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise AdvisoryError(f"{path}: {error}") from error
    try:
        whole = json.loads(text)
    except ValueError:
        try:
            whole = [json.loads(line) for line in text.splitlines() if line.strip()]
        except ValueError as error:
            raise AdvisoryError(f"{path}: JSON is expected: {error}") from error
    for each in whole if isinstance(whole, list) else [whole]:
        if not isinstance(each, dict) or not isinstance(each.get("id"), str):
            raise AdvisoryError(f"{path}: an advisory has an id")
        yield each


def _parsed(version: str) -> Version | None:
    try:
        return Version(version)
    except InvalidVersion:
        return None


def same_version(one: str, other: str) -> bool:
    """Return whether two texts are one version by PEP 440, or the same text."""
    return one == other or (_parsed(one) is not None and _parsed(one) == _parsed(other))


def _spans(events: Sequence[Mapping[str, str]], text: str) -> bool:
    """Return whether the newest event at or below a version states that the vulnerability is present."""
    version = _parsed(text)
    if version is None:
        return False
    is_vulnerable = False
    for bound, kind in sorted(_bounds(events)):
        if _KINDS[kind] == "introduced" and version >= bound:
            is_vulnerable = True
        elif (_KINDS[kind] == "fixed" and version >= bound) or (_KINDS[kind] == "last_affected" and version > bound):
            is_vulnerable = False
    return is_vulnerable


def _bounds(events: Sequence[Mapping[str, str]]) -> Iterator[tuple[Version, int]]:
    """Yield the version and the kind of each event; "0" is before every version."""
    for event in events:
        for kind, at in event.items():
            bound = Version("0.dev0") if at == "0" else _parsed(at)
            if kind in _KINDS and bound is not None:
                yield bound, _KINDS.index(kind)
