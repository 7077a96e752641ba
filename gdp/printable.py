"""Printable forms of text that others wrote: no control, bidirectional or invisible characters reach a terminal or log.

Sans-I/O. Source: ``str.isprintable``; RFC 8259, section 7, for the escapes of ``escaped``, so that JSON stays JSON.
"""

from __future__ import annotations

import json
from typing import Final

_CHARS_MAX: Final = 300
_LAYOUT: Final = "\n\t"


def printable(text: str) -> str:
    """Return one line of at most 300 characters, and a mark where the text was cut; invisible ones are escaped."""
    kept = text[:_CHARS_MAX]
    if not kept.isprintable():
        kept = "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in kept)
    return kept[:_CHARS_MAX] + (" ..." if len(text) > _CHARS_MAX or len(kept) > _CHARS_MAX else "")


def escaped(text: str) -> str:
    """Return whole text with its lines and tabs; every other character that is not printable is ``\\uXXXX``."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() or each in _LAYOUT else _escape(each) for each in text)


def _escape(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code <= 0xFFFF else json.dumps(character)[1:-1]
