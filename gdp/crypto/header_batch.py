"""Header batch: headers, additional data and nonces for many parts of one message at once.

Sans-I/O. Source: ``frame/spec.md``. From part to part only the part's number changes. So a template is repeated and the
numbers are written over it, one byte column at a time::

    headers      version kind flags hops | epoch length number PART parts incarnation destination source | salt
    additional   version kind flags      | the same as far as the source                                 95 bytes
    nonces                                 number PART                                                   12 bytes
"""

from __future__ import annotations

import struct
import sys
from array import array
from collections.abc import Iterator
from typing import Final

from gdp.frame.codec import AAD_BYTES, HEADER_BYTES, Header, authenticated, encode

__all__ = ["NONCE_BYTES", "HeaderBatch"]

NONCE_BYTES: Final = 12
_NONCE: Final = struct.Struct("!QI")
_NONCE_WHOLE: Final = struct.Struct(f"{NONCE_BYTES}s")
_ADDITIONAL: Final = struct.Struct(f"{AAD_BYTES}s")
_PART_AT: Final = 16
_PART_BYTES: Final = 4
_PART_IN_NONCE: Final = 8


class HeaderBatch:
    """The headers of parts ``first`` to ``first + count`` of a message, all of one length and one set of flags.

    Args:
        header: of any of them; its part does not matter.
        salt: of the message; it stands behind each header.

    Attributes:
        headers, additional, nonces: side by side, 96 and the salt, 95 and 12 bytes a part.
    """

    __slots__ = ("additional", "count", "first", "headers", "nonces", "salt")

    def __init__(self, header: Header, first: int, count: int, salt: bytes = b"") -> None:
        self.first = first
        self.count = count
        self.salt = salt
        template = encode(header) + salt
        width = len(template)
        headers = bytearray(template * count)
        additional = bytearray(authenticated(template) * count)
        nonces = bytearray(_NONCE.pack(header.number, 0) * count)
        numbers = array("I", range(first, first + count))
        if sys.byteorder == "little":
            numbers.byteswap()
        columns = numbers.tobytes()
        for at in range(_PART_BYTES):
            column = columns[at::_PART_BYTES]
            headers[_PART_AT + at :: width] = column
            additional[_PART_AT - 1 + at :: AAD_BYTES] = column
            nonces[_PART_IN_NONCE + at :: NONCE_BYTES] = column
        self.headers = bytes(headers)
        self.additional = bytes(additional)
        self.nonces = bytes(nonces)

    def each(self) -> tuple[Iterator[tuple[bytes]], Iterator[tuple[bytes]], Iterator[tuple[bytes]]]:
        """Return header with salt, additional data and nonce of each part, in order, by three iterators."""
        headers = struct.iter_unpack(f"{HEADER_BYTES + len(self.salt)}s", self.headers)
        additional = _ADDITIONAL.iter_unpack(self.additional)
        return headers, additional, _NONCE_WHOLE.iter_unpack(self.nonces)
