"""Diagnostic notation of a stranger's CBOR, for people; anything else is None.

Sans-I/O. It serves displays of frames, never forwarding or trust. Source: diagnostic notation, RFC 8949, section 8; a
byte string that holds CBOR itself is shown as ``<<...>>`` (RFC 8610, appendix G.3). The reader accepts what a statement
may contain, no deeper than ``CBOR_DEPTH_MAX``: no indefinite lengths, no simple values but false, true and null.
"""

from __future__ import annotations

import json
import struct
from typing import Final

from gdp.limits import CBOR_DEPTH_MAX, CONTROL_MAX_BYTES

SHOWN_BYTES: Final = 32  # a name is shown completely, a longer string by its beginning and its size
_SIMPLE: Final = {20: "false", 21: "true", 22: "null"}
_FLOATS: Final = {2: struct.Struct("!e"), 4: struct.Struct("!f"), 8: struct.Struct("!d")}
_UINT, _NEGATIVE, _BYTES, _TEXT, _ARRAY, _MAP, _TAG, _OTHER = range(8)


def diagnose(data: bytes) -> str | None:
    """Return the notation of exactly one item, or None: not CBOR, more than one item, too deep or too long."""
    if len(data) > CONTROL_MAX_BYTES:
        return None
    try:
        text, end = _item(data, 0, 0)
    except ValueError:
        return None
    return text if end == len(data) else None


def byte_string(data: bytes) -> tuple[int, int]:
    """Return where the byte string at the start of ``data`` begins and ends, its head excluded.

    Raises:
        ValueError: there is no complete byte string.
    """
    major, length, at = _head(data, 0)
    if major != _BYTES or at + length > len(data):
        raise ValueError("no byte string")
    return at, at + length


def _head(data: bytes, at: int) -> tuple[int, int, int]:
    """Return major type, argument, and where the content begins."""
    if at >= len(data):
        raise ValueError("ends early")
    major, small = data[at] >> 5, data[at] & 31
    if small < 24:
        return major, small, at + 1
    size = {24: 1, 25: 2, 26: 4, 27: 8}.get(small, 0)
    end = at + 1 + size
    if not size or end > len(data):
        raise ValueError("an indefinite length, or ends early")
    return major, int.from_bytes(data[at + 1 : end], "big"), end


def _item(data: bytes, at: int, depth: int) -> tuple[str, int]:
    """Return the text of the item at ``at``, and where it ends."""
    if depth > CBOR_DEPTH_MAX:
        raise ValueError("too deep")
    begin = at
    major, argument, at = _head(data, at)
    if major == _UINT:
        return str(argument), at
    if major == _NEGATIVE:
        return str(-1 - argument), at
    if major in (_BYTES, _TEXT):
        end = at + argument
        if end > len(data):
            raise ValueError("ends early")
        piece = data[at:end]
        return (_bytes(piece, depth) if major == _BYTES else json.dumps(piece.decode())), end
    if major == _TAG:
        text, at = _item(data, at, depth + 1)
        return f"{argument}({text})", at
    if major == _OTHER:
        return _other(data[begin + 1 : at], argument), at
    if argument > len(data) - at:  # an item has at least one byte
        raise ValueError("more items than bytes")
    texts: list[str] = []
    for _ in range(argument):
        text, at = _item(data, at, depth + 1)
        if major == _MAP:
            value, at = _item(data, at, depth + 1)
            text = f"{text}: {value}"
        texts.append(text)
    inside = ", ".join(texts)
    return (f"{{{inside}}}" if major == _MAP else f"[{inside}]"), at


def _other(content: bytes, argument: int) -> str:
    """Show a float or one of the three simple values."""
    if len(content) in _FLOATS:
        return repr(_FLOATS[len(content)].unpack(content)[0])
    if content or argument not in _SIMPLE:
        raise ValueError("an unknown simple value")
    return _SIMPLE[argument]


def _bytes(piece: bytes, depth: int) -> str:
    """Show embedded CBOR (a map or a tagged statement) as such, else hex digits."""
    if len(piece) > 1 and piece[0] >> 5 in (_MAP, _TAG):
        try:
            text, end = _item(piece, 0, depth + 1)
        except ValueError:
            end = -1
        if end == len(piece):
            return f"<<{text}>>"
    if len(piece) <= SHOWN_BYTES:
        return f"h'{piece.hex()}'"
    return f"h'{piece[:8].hex()}…' ({len(piece)} bytes)"
