"""Words of a far node as one line of a log or a terminal: no line breaks, no control characters, no end of memory.

Layer: sans-I/O.
"""

from __future__ import annotations

from typing import Final

__all__ = ["printable"]

_CHARS_MAX: Final = 300


def printable(text: str, chars_max: int = _CHARS_MAX) -> str:
    """Return a text of at most ``chars_max`` characters, and a mark where it was cut; what is unseen is escaped."""
    kept = text[:chars_max]
    if not kept.isprintable():
        kept = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in kept)
    return kept[:chars_max] + (" ..." if len(text) > chars_max or len(kept) > chars_max else "")
