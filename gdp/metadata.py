"""Metadata: the flat map that describes a topic, a service or a node, and its canonical bytes.

Sans-I/O. Source: RFC 8949, section 4.2.1 (deterministic CBOR).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Final

import cbor2

from gdp.errors import LocalError
from gdp.names import Name, name_of

KINDS: Final = frozenset(
    {"topic", "service", "action", "node", "domain", "switch", "leaf", "rib", "proxy", "door", "enrolment", "capsule"}
)
SALT: Final = "salt"  # key of the unguessable part
_VALUE_MAX_CHARS: Final = 4_096


class Metadata(Mapping[str, "str | int"]):
    """An immutable flat map of text keys to text or whole numbers; ``kind`` is required.

    Raises:
        LocalError: no or an unknown kind, a key or value of the wrong type, an empty key, a value out of bounds.
    """

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[str, str | int]) -> None:
        for key, value in items.items():
            if not isinstance(key, str) or not key:
                raise LocalError(f"a metadata key is a non-empty text, not {key!r}")
            if isinstance(value, bool) or not isinstance(value, str | int):
                raise LocalError(f"metadata {key!r} is a text or a whole number, not {type(value).__name__}")
            if isinstance(value, str) and len(value) > _VALUE_MAX_CHARS:
                raise LocalError(f"metadata {key!r} has more than {_VALUE_MAX_CHARS} characters")
            if isinstance(value, int) and not -(1 << 63) <= value < 1 << 64:
                raise LocalError(f"metadata {key!r} does not fit in 64 bits")
        if items.get("kind") not in KINDS:
            raise LocalError(f"metadata 'kind' is one of {', '.join(sorted(KINDS))}, not {items.get('kind')!r}")
        self._items = dict(items)

    def __getitem__(self, key: str) -> str | int:
        return self._items[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return f"Metadata({self._items!r})"

    def to_wire(self) -> bytes:
        """Return the canonical CBOR: shortest forms, keys in bytewise order of their encoding."""
        return cbor2.dumps(self._items, canonical=True)

    def digest(self) -> bytes:
        """Return SHA-256 of the canonical bytes, which represents them in an advertisement."""
        return hashlib.sha256(self.to_wire()).digest()

    def name(self, owner_key: bytes = b"") -> Name:
        """Return the name under this owner (33-byte compressed P-256 point; empty: unowned)."""
        return name_of(self.digest(), owner_key)


def hidden(metadata: Mapping[str, str | int]) -> dict[str, str | int]:
    """Return metadata for display, without the salt's text."""
    return {key: "(hidden)" if key == SALT else value for key, value in metadata.items()}
