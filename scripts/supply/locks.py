"""Lock files: the permitted packages, each by version and hashes.

Source: pip's "Requirements File Format" and "Secure installs"; names as in PEP 503, markers as in PEP 508.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from packaging.utils import canonicalize_name

_PIN = re.compile(r"(?P<name>[\w.\-]+)(?:\[[\w,.\- ]+\])?==(?P<version>[\w.!+\-]+)(?: *; *(?P<marker>[^\\]+?))?\Z")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})\Z")


class LockError(Exception):
    """File that is not a lock; the text names the line."""


@dataclass(frozen=True)
class Pin:
    """One version of one package.

    ``name``: as PEP 503 writes it. ``marker``: condition; empty: everywhere. ``hashes``: SHA-256 of each archive that
    may be installed, hex.
    """

    name: str
    version: str
    marker: str
    hashes: frozenset[str]


def read_lock(path: Path) -> list[Pin]:
    """Return the pins of a lock, in order.

    Raises ``LockError``: a line that is neither a pin with hashes nor a comment. Raises ``OSError``: it cannot be read.
    """
    pins: list[Pin] = []
    joined = ""
    for number, line in enumerate(path.read_text().splitlines(), 1):
        text = line.strip()
        if not joined and (not text or text.startswith("#")):
            continue
        joined += " " + text.removesuffix("\\").strip()
        if text.endswith("\\"):
            continue
        requirement, *options = re.split(r" (?=--)", joined.strip())
        match, hashes = _PIN.match(requirement.strip()), [_HASH.match(option.strip()) for option in options]
        if match is None or not hashes or None in hashes:
            raise LockError(f"{path}:{number}: expected name==version with --hash=sha256:HEX")
        digests = frozenset(each[1] for each in hashes if each)
        pins.append(Pin(canonicalize_name(match["name"]), match["version"], (match["marker"] or "").strip(), digests))
        joined = ""
    return pins
