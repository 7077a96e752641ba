"""Replication statements between the RIBs of one domain, so that each holds what any of them accepted.

Sans-I/O. A ``Digest`` summarises by hashes what a RIB holds below a prefix of names; a ``Fetch`` requests the detail of
prefixes, or entries; an ``Inventory`` lists names with their sequence numbers; ``EntryBatch`` has the entries, which
prove themselves. Source: Merkle-tree anti-entropy (DeCandia et al., Dynamo, 2007, section 4.7).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from gdp.control.query import TRANSIT_MAX
from gdp.crypto.schema import (
    CERT,
    FLAG,
    NAME,
    OCTETS,
    STATEMENT,
    Body,
    FieldSet,
    Form,
    Keyed,
    inner,
    many,
    number,
    octets,
    packed,
    uint,
)
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.limits import CONTROL_MAX_BYTES, LEASE_MAX_S
from gdp.names import NAME_BYTES, Name

__all__ = ["Digest", "Entry", "EntryBatch", "Fetch", "Inventory", "Item", "Key", "batches"]

FANOUT: Final = 256
HASH_BYTES: Final = 8
PREFIX_MAX_BYTES: Final = 2
FETCH_PREFIXES_MAX: Final = 16
FETCH_KEYS_MAX: Final = 64
INVENTORY_MAX: Final = 128  # items of 73 bytes: 9.3 KiB
ENTRIES_MAX: Final = 64
_CAPACITY_BYTES: Final = CONTROL_MAX_BYTES - 4_096  # excludes a membership, which has at most 4 KiB
_ENTRY_COST_BYTES: Final = 180  # keys, names and heads of one entry, in addition to its byte strings
_KEY_BYTES: Final = 2 * NAME_BYTES

Key = tuple[Name, Name]  # name, advertiser


_PREFIX: Final = octets(most=PREFIX_MAX_BYTES)
_NAMES: Final[Form[Key]] = packed(
    _KEY_BYTES, lambda key: (Name(key[:NAME_BYTES]), Name(key[NAME_BYTES:])), lambda key: key[0] + key[1]
)


@dataclass(frozen=True, slots=True)
class Digest(Body):
    """Hashes of what a RIB holds below a prefix.

    Args:
        prefix: of names, up to 1 byte here.
        hashes: 8 bytes for all, or 256 times 8 bytes, one for each next byte.
        is_last: whether the reply to a ``Fetch`` ends here.
    """

    TYPE = StatementType.DIGEST
    prefix: Annotated[bytes, Keyed("p", _PREFIX)]
    hashes: Annotated[bytes, Keyed("h", OCTETS)]
    is_last: Annotated[bool, Keyed("z", FLAG)]

    def check(self) -> None:
        """Return if there is one hash, or one for each next byte. Raises ``StatementError``: MALFORMED."""
        if len(self.hashes) not in (HASH_BYTES, FANOUT * HASH_BYTES):
            raise StatementError(DropReason.MALFORMED, "a digest of another length")


@dataclass(frozen=True, slots=True)
class Fetch(Body):
    """A request for the detail of prefixes and for entries."""

    TYPE = StatementType.FETCH
    prefixes: Annotated[tuple[bytes, ...], Keyed("p", many(_PREFIX, FETCH_PREFIXES_MAX))]
    keys: Annotated[tuple[Key, ...], Keyed("k", many(_NAMES, FETCH_KEYS_MAX))]


@dataclass(frozen=True, slots=True)
class Item:
    """One line of an inventory."""

    name: Name
    advertiser: Name
    sequence: int
    is_withdrawn: bool

    @classmethod
    def from_bytes(cls, line: bytes) -> Item:
        """Return the item of a line: name, advertiser, sequence number (8), whether it is withdrawn (1)."""
        name, advertiser = Name(line[:NAME_BYTES]), Name(line[NAME_BYTES:_KEY_BYTES])
        return cls(name, advertiser, int.from_bytes(line[_KEY_BYTES:-1], "big"), line[-1] != 0)

    def to_bytes(self) -> bytes:
        """Return its line."""
        return self.name + self.advertiser + self.sequence.to_bytes(8, "big") + bytes([self.is_withdrawn])

    @property
    def key(self) -> Key:
        """Return the name and the advertiser."""
        return self.name, self.advertiser

    @property
    def rank(self) -> int:
        """Return a rank that is higher for the newer item: by sequence number, then the withdrawal."""
        return 2 * self.sequence + self.is_withdrawn


_ITEM: Final = packed(_KEY_BYTES + 9, Item.from_bytes, Item.to_bytes)


@dataclass(frozen=True, slots=True)
class Inventory(Body):
    """Names that a RIB holds, with the sequence number of each advertiser."""

    TYPE = StatementType.INVENTORY
    items: Annotated[tuple[Item, ...], Keyed("i", many(_ITEM, INVENTORY_MAX))]
    is_last: Annotated[bool, Keyed("z", FLAG)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry(FieldSet):
    """An advertisement or a withdrawal as one RIB sends it to another.

    Args:
        statement: signed by its maker.
        membership: of the maker of a withdrawal, whose advertisement need not be known; empty for an advertisement.
        sender: the switch or RIB that relayed it.
        domain: domain of the advertisement's switch.
        via: the domain of ``sender``.
        transit: domains through which that domain lets its traffic pass.
        lease_s: what is left of the lease.
        is_from_upstream: received from the tier above.
        until_unix_s: when a withdrawal may be forgotten, because its advertisement is no longer provable; 0 for an
            advertisement.
    """

    statement: Annotated[bytes, Keyed("q", STATEMENT)]
    membership: Annotated[bytes, Keyed("m", CERT)]
    sender: Annotated[Name, Keyed("w", NAME)]
    domain: Annotated[Name, Keyed("d", NAME)]
    via: Annotated[Name, Keyed("v", NAME)]
    transit: Annotated[tuple[Name, ...], Keyed("x", many(NAME, TRANSIT_MAX))]
    lease_s: Annotated[float, Keyed("l", number(0, LEASE_MAX_S))]
    is_from_upstream: Annotated[bool, Keyed("u", FLAG)]
    until_unix_s: Annotated[int, Keyed("t", uint())] = 0

    @property
    def cost_bytes(self) -> int:
        """Return the bytes that the entry occupies in a statement, at most."""
        return len(self.statement) + len(self.membership) + len(self.transit) * (NAME_BYTES + 2) + _ENTRY_COST_BYTES


@dataclass(frozen=True, slots=True)
class EntryBatch(Body):
    """Entries of one RIB for another, pushed when they are new or fetched."""

    TYPE = StatementType.REPLICAS
    entries: Annotated[tuple[Entry, ...], Keyed("e", many(inner(Entry), ENTRIES_MAX))]
    is_last: Annotated[bool, Keyed("z", FLAG)]


def batches(entries: Sequence[Entry]) -> Iterator[tuple[Entry, ...]]:
    """Yield entries in groups that fit one statement each; an entry that fits none is left out."""
    group: list[Entry] = []
    size = 0
    for entry in entries:
        cost = entry.cost_bytes
        if cost > _CAPACITY_BYTES:
            continue
        if group and (size + cost > _CAPACITY_BYTES or len(group) >= ENTRIES_MAX):
            yield tuple(group)
            group, size = [], 0
        group.append(entry)
        size += cost
    if group:
        yield tuple(group)
