#!/usr/bin/env python3
"""Stamp of the dependency tables in each lock: shows without a network whether a lock is older than pyproject.toml.

scripts/supply/lock_stamp.py --check     exit 1 and name each lock that is out of date
scripts/supply/lock_stamp.py --write     stamp every lock; scripts/lock.sh does this after it resolved them
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_STAMP = re.compile(r"# pyproject dependencies: sha256:([0-9a-f]{64})\n")
_BASE = re.compile(r"^dependencies = \[$.*?^\]$", re.MULTILINE | re.DOTALL)
_EXTRAS = re.compile(r"^\[project\.optional-dependencies\]$.*?(?=^\[)", re.MULTILINE | re.DOTALL)
_PYTHON = re.compile(r"^requires-python = .*$", re.MULTILINE)


class TableError(Exception):
    """pyproject.toml has no dependency table where one is expected."""


def dependency_digest(root: Path) -> str:
    """Return SHA-256, in hex, of the dependency tables and of requirements/build.in; blanks and order do not count.

    Raises ``OSError``: a file cannot be read. Raises ``TableError``: a table of pyproject.toml is missing.
    """
    text = (root / "pyproject.toml").read_text()
    digest = hashlib.sha256()
    for pattern in (_PYTHON, _BASE, _EXTRAS):
        match = pattern.search(text)
        if match is None:
            raise TableError(f"pyproject.toml: nothing matches {pattern.pattern}")
        parts = sorted(line.strip() for line in match[0].splitlines() if line.strip())
        digest.update("\n".join([*parts, ""]).encode())
    digest.update((root / "requirements" / "build.in").read_bytes())
    return digest.hexdigest()


def outdated_locks(root: Path) -> list[str]:
    """Return the names of locks whose stamp is missing or differs from pyproject.toml."""
    wanted = dependency_digest(root)
    found: list[str] = []
    for path in sorted((root / "requirements").glob("*.lock")):
        match = _STAMP.match(path.read_text())
        if match is None or match[1] != wanted:
            found.append(path.name)
    return found


def stamp_locks(root: Path) -> None:
    """Write the present digest into the first line of every lock."""
    line = f"# pyproject dependencies: sha256:{dependency_digest(root)}\n"
    for path in sorted((root / "requirements").glob("*.lock")):
        path.write_text(line + _STAMP.sub("", path.read_text()))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    head, _, text = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=head, epilog=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--check", action="store_true", help="exit 1 if a lock is out of date")
    action.add_argument("--write", action="store_true", help="stamp every lock")
    if parser.parse_args(argv).write:
        stamp_locks(ROOT)
        return 0
    outdated = outdated_locks(ROOT)
    for name in outdated:
        print(f"requirements/{name}: older than pyproject.toml (run scripts/lock.sh)", file=sys.stderr)
    return 1 if outdated else 0


if __name__ == "__main__":
    sys.exit(main())
