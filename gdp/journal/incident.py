"""Incident: a saved journal. A file that shows what happened at a node, and from which its core is run again.

Sans-I/O. ``docs/reference/incidents.md`` has the format::

    "GDPI"  version 1 (1)  zlib( length (4) CBOR map, then for each entry length (4) CBOR list )  SHA-256 of all (32)

The entries have no random bytes, from which session keys follow: these are sealed to the node's own KEM key.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final

from gdp.crypto.cbor import decode, encode
from gdp.crypto.kem import KemPrivateKey, KemPublicKey
from gdp.errors import LocalError, RemoteError
from gdp.journal.journal import LENGTH

_MAGIC: Final = b"GDPI"
_VERSION: Final = 1
_DIGEST_BYTES: Final = 32
_BODY_MAX_BYTES: Final = 1 << 30
_ITEM_MAX_BYTES: Final = 1 << 24
_INFO: Final = b"gdp incident 1"


@dataclass(frozen=True, slots=True)
class Incident:
    """A journal as read from a node or a file.

    Args:
        head: as from ``Journal.head``; ``drawn``: all random bytes, sealed.
        entries: as in ``journal.py``; where ``drawn`` has the random bytes, their number stands in their place.
    """

    head: Mapping[str, Any]
    entries: list[list[Any]]

    @classmethod
    def from_blocks(cls, head: Mapping[str, Any], blocks: Iterable[bytes]) -> Incident:
        """Return the incident of a journal. Raises ``LocalError``: a block is of the wrong form."""
        with well_formed("journal"):
            return cls(head, [_entry(item) for block in blocks for item in _items(block)])

    def sealed(self) -> Incident:
        """Return this incident as only the node itself can replay it."""
        with well_formed("head or an entry"):
            drawn = b"".join(entry[1] for entry in self.entries if entry[0] == "draw")
            sealed = KemPublicKey.from_wire(self.head["kem"]).seal(drawn, _INFO)
        entries = [[kind, len(more[0])] if kind == "draw" else [kind, *more] for kind, *more in self.entries]
        return Incident({**self.head, "drawn": sealed}, entries)

    def opened(self, kem: KemPrivateKey) -> Incident:
        """Return this incident with its random bytes. Raises ``LocalError``: another node saved it."""
        try:
            drawn = BytesIO(kem.open(self.head["drawn"], _INFO))
        except RemoteError as error:
            raise LocalError("another node saved this incident: only its own keys open what it drew") from error
        entries = [[kind, drawn.read(more[0])] if kind == "draw" else [kind, *more] for kind, *more in self.entries]
        return Incident({key: value for key, value in self.head.items() if key != "drawn"}, entries)

    def to_bytes(self) -> bytes:
        """Return the content of a file."""
        items = (encode(self.head), *map(encode, self.entries))
        body = zlib.compress(b"".join(LENGTH.pack(len(item)) + item for item in items))
        data = _MAGIC + bytes([_VERSION]) + body
        return data + hashlib.sha256(data).digest()

    @classmethod
    def from_bytes(cls, data: bytes) -> Incident:
        """Read the content of a file. Raises ``LocalError``: it is none, another version's, or damaged."""
        if not data.startswith(_MAGIC) or len(data) <= len(_MAGIC):
            raise LocalError("no incident: gdp incident save writes one")
        if data[len(_MAGIC)] != _VERSION:
            raise LocalError(f"an incident of version {data[len(_MAGIC)]}; this program reads version {_VERSION}")
        content, digest = data[:-_DIGEST_BYTES], data[-_DIGEST_BYTES:]
        if hashlib.sha256(content).digest() != digest:
            raise LocalError("a damaged incident: its checksum is another; save or copy it again")
        with well_formed("body"):
            head, *entries = _items(content[len(_MAGIC) + 1 :])
            if not isinstance(fields := decode(head, _ITEM_MAX_BYTES), dict):
                raise ValueError("no head")
            return cls(fields, [_entry(each) for each in entries])


def _items(block: bytes) -> Iterator[bytes]:
    inflater = zlib.decompressobj()
    body = inflater.decompress(block, _BODY_MAX_BYTES)
    if not inflater.eof:
        raise ValueError("more than its bound")
    at = 0
    while at < len(body):
        (size,) = LENGTH.unpack_from(body, at)
        at += LENGTH.size + size
        yield body[at - size : at]


def _entry(wire: bytes) -> list[Any]:
    entry = decode(wire, _ITEM_MAX_BYTES)
    if not isinstance(entry, list) or not entry or not isinstance(entry[0], str):
        raise ValueError("an entry that is no list with a word")
    return entry


@contextmanager
def well_formed(part: str) -> Iterator[None]:
    """Translate what wrong values of a file cause."""
    try:
        yield
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RemoteError,
        TypeError,
        ValueError,
        struct.error,
        zlib.error,
    ) as error:
        raise LocalError(f"an incident of the wrong form: its {part}: {error!r}") from error
