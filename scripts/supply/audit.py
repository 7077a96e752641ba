#!/usr/bin/env python3
"""Audit of installed packages against a lock, and against advisories of known vulnerabilities. Uses no network.

    .venv/bin/python scripts/supply/audit.py --lock requirements/dev.lock
    .venv/bin/python scripts/supply/audit.py --lock requirements/run.lock --advisories advisory-database/vulns

The audit checks each distribution that the running interpreter finds. The lock must pin it here, in that version, and
its files must be those that its RECORD states. A virtual environment brings pip, setuptools and wheel: they are
compared where the lock pins them. Exit: 0 nothing found, 1 something, 2 wrong usage. ``pip-audit`` reads no advisories
from files, and asks a service for each package.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import NamedTuple

from advisories import AdvisoryError, is_affected, read_advisories, same_version
from locks import LockError, Pin, pins_here, read_lock
from packaging.utils import canonicalize_name

OURS = "gdp-ros"
_METADATA = re.compile(
    r"(?P<name>[^/]+?)-(?P<version>[^/\-]+)(?:\.dist-info/METADATA|(?:-py[\d.]+)?\.egg-info/PKG-INFO)\Z"
)
_WITH_EVERY_VENV = frozenset({"pip", "setuptools", "wheel"})


class Finding(NamedTuple):
    """Difference from the lock, a RECORD or an advisory."""

    kind: str  # not-pinned, other-version, changed-file, missing-file, advisory
    name: str
    detail: str


def compare(installed: Iterable[Distribution], pins: Sequence[Pin]) -> Iterator[Finding]:
    """Yield each distribution that the lock does not pin here, or pins in another version.

    Some packages contain others: the wheel of ros-rclpy contains rclpy, so its pin covers both.
    """
    here = pins_here(list(pins))
    dists = sorted(installed, key=_name)
    carried = {metadata for each in dists if _name(each) in here for metadata in _metadata_in(each)}
    for each in dists:
        name = _name(each)
        pinned = here.get(name, [])
        if not pinned and name not in _WITH_EVERY_VENV:
            if (name, each.version) not in carried:
                yield Finding("not-pinned", name, each.version)
        elif pinned and not any(same_version(pin.version, each.version) for pin in pinned):
            yield Finding("other-version", name, f"{each.version}, pinned {', '.join(pin.version for pin in pinned)}")


def check_files(installed: Iterable[Distribution]) -> Iterator[Finding]:
    """Yield each installed file that is not the one that its distribution's RECORD states."""
    for each in sorted(installed, key=_name):
        for file in each.files or ():
            if file.hash is None or file.suffix == ".pyc":
                continue
            path = Path(str(each.locate_file(file)))
            if not path.is_file():
                yield Finding("missing-file", _name(each), str(file))
                continue
            digest = hashlib.new(file.hash.mode, path.read_bytes()).digest()
            if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != file.hash.value:
                yield Finding("changed-file", _name(each), str(file))


def check_advisories(installed: Iterable[Distribution], path: Path) -> Iterator[Finding]:
    """Yield each distribution whose version has a vulnerability by an advisory.

    Raises ``AdvisoryError``: no advisories can be read there.
    """
    advisories = read_advisories(path)
    for each in sorted(installed, key=_name):
        for advisory in advisories:
            if is_affected(advisory, _name(each), each.version):
                summary = advisory.get("summary") or next(iter(str(advisory.get("details", "")).splitlines()), "")
                yield Finding("advisory", _name(each), f"{each.version}: {advisory['id']} {summary}".rstrip())


def main(words: Sequence[str] | None = None, installed: Iterable[Distribution] | None = None) -> int:
    """Run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lock", type=Path, required=True, help="a file of requirements/")
    parser.add_argument("--advisories", type=Path, help="OSV: a file, or a folder of them")
    parser.add_argument("--json", action="store_true", help="findings as JSON")
    given = parser.parse_args(words)
    found = list(distributions()) if installed is None else list(installed)
    dists = [each for each in {_name(each): each for each in reversed(found)}.values() if _name(each) != OURS]
    try:
        pins = read_lock(given.lock)
        findings = [*compare(dists, pins), *check_files(dists)]
        if given.advisories:
            findings += check_advisories(dists, given.advisories)
    except (LockError, AdvisoryError, OSError) as error:
        print(f"audit: {error}", file=sys.stderr)
        return 2
    if given.json:
        print(json.dumps([each._asdict() for each in findings], indent=2))
    else:
        for each in findings:
            print(f"{each.kind:16} {each.name}  {each.detail}")
        print(f"{len(dists)} distributions, {len(findings)} findings")
    return 1 if findings else 0


def _metadata_in(each: Distribution) -> Iterator[tuple[str, str]]:
    """Yield name and version of each distribution whose metadata are among the files of one."""
    for file in each.files or ():
        match = _METADATA.search(str(file))
        if match is not None:
            yield canonicalize_name(match["name"]), match["version"]


def _name(each: Distribution) -> str:
    return canonicalize_name(each.metadata["Name"] or "")


if __name__ == "__main__":
    sys.exit(main())
