"""Printable form of a remote node's text, as one line: no line breaks, no control characters, bounded length.

Sans-I/O.
"""

from __future__ import annotations

from typing import Final

__all__ = ["printable"]

_CHARS_MAX: Final = 300


def printable(text: str) -> str:
    """Return at most 300 characters, and a mark where the text was cut; invisible ones are escaped."""
    kept = text[:_CHARS_MAX]
    if not kept.isprintable():
        kept = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in kept)
    return kept[:_CHARS_MAX] + (" ..." if len(text) > _CHARS_MAX or len(kept) > _CHARS_MAX else "")
