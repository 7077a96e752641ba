"""Printable form of a remote node's text, as one line: no line breaks, no control characters, bounded length.

Sans-I/O.
"""

from __future__ import annotations

from typing import Final

__all__ = ["printable"]

_CHARS_MAX: Final = 300


def printable(text: str, chars_max: int = _CHARS_MAX) -> str:
    """Return at most ``chars_max`` characters, and a mark where the text was cut; invisible ones are escaped."""
    kept = text[:chars_max]
    if not kept.isprintable():
        kept = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in kept)
    return kept[:chars_max] + (" ..." if len(text) > chars_max or len(kept) > chars_max else "")
