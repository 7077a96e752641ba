"""Bounded log: a full file becomes the older half, and a new file begins."""

from __future__ import annotations

from collections import deque
from itertools import chain
from pathlib import Path
from typing import Final

_HALF_BYTES: Final = 2 << 20


class BoundedLog:
    """Log that appends to ``path``; older lines are in ``path`` with ``.1`` appended, still older ones are deleted.

    Args:
        half_bytes: maximum size of each of the two files.
    """

    def __init__(self, path: Path, half_bytes: int = _HALF_BYTES) -> None:
        self._path = path
        self._half_bytes = half_bytes
        self._file = path.open("ab", buffering=0)

    def write(self, data: bytes) -> None:
        """Append; begin a new file if this one would exceed its limit."""
        if self._file.tell() and self._file.tell() + len(data) > self._half_bytes:
            self._file.close()
            self._path.replace(_older(self._path))
            self._file = self._path.open("ab", buffering=0)
        self._file.write(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def last_lines(path: Path, lines: int) -> str:
    """Return the last lines of a bounded log, or of any file; empty if there is none."""
    found = [each for each in (_older(path), path) if each.is_file()]
    texts = (each.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True) for each in found)
    return "".join(deque(chain.from_iterable(texts), maxlen=lines))


def _older(path: Path) -> Path:
    return path.with_name(f"{path.name}.1")
