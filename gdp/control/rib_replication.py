"""Replication statements between the RIBs of one domain, so that each holds what any of them accepted.

Sans-I/O. A ``Digest`` summarises by hashes what a RIB holds below a prefix of names; a ``Fetch`` requests the detail of
prefixes, or entries; an ``Inventory`` lists names with their sequence numbers; ``EntryBatch`` has the entries, which
prove themselves. Source: Merkle-tree anti-entropy (DeCandia et al., Dynamo, 2007, section 4.7).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from gdp.control.query import TRANSIT_MAX
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
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


@dataclass(frozen=True, slots=True)
class Digest:
    """Hashes of what a RIB holds below a prefix.

    Args:
        prefix: of names, up to 1 byte here.
        hashes: 8 bytes for all, or 256 times 8 bytes, one for each next byte.
        is_last: whether the reply to a ``Fetch`` ends here.
    """

    prefix: bytes
    hashes: bytes
    is_last: bool

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        body = {"p": self.prefix, "h": self.hashes, "z": self.is_last, "c": membership}
        return sign(StatementType.DIGEST, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Digest:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        digest = cls(_prefix(fields.bytes_("p")), fields.bytes_("h"), fields.flag("z"))
        if len(digest.hashes) not in (HASH_BYTES, FANOUT * HASH_BYTES):
            raise StatementError(DropReason.MALFORMED, "a digest of another length")
        return digest


@dataclass(frozen=True, slots=True)
class Fetch:
    """A request for the detail of prefixes and for entries."""

    prefixes: tuple[bytes, ...]
    keys: tuple[Key, ...]

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        keys = [bytes(name) + bytes(advertiser) for name, advertiser in self.keys]
        return sign(StatementType.FETCH, {"p": list(self.prefixes), "k": keys, "c": membership}, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Fetch:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        prefixes = tuple(_prefix(each) for each in fields.byte_strings("p", FETCH_PREFIXES_MAX))
        keys = fields.byte_strings("k", FETCH_KEYS_MAX, _KEY_BYTES)
        return cls(prefixes, tuple((Name(key[:NAME_BYTES]), Name(key[NAME_BYTES:])) for key in keys))


@dataclass(frozen=True, slots=True)
class Item:
    """One line of an inventory."""

    name: Name
    advertiser: Name
    sequence: int
    is_withdrawn: bool

    @property
    def key(self) -> Key:
        """Return the name and the advertiser."""
        return self.name, self.advertiser

    @property
    def rank(self) -> int:
        """Return a rank that is higher for the newer item: by sequence number, then the withdrawal."""
        return 2 * self.sequence + self.is_withdrawn


@dataclass(frozen=True, slots=True)
class Inventory:
    """Names that a RIB holds, with the sequence number of each advertiser."""

    items: tuple[Item, ...]
    is_last: bool

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        lines = [
            bytes(item.name) + bytes(item.advertiser) + item.sequence.to_bytes(8, "big") + bytes([item.is_withdrawn])
            for item in self.items
        ]
        return sign(StatementType.INVENTORY, {"i": lines, "z": self.is_last, "c": membership}, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Inventory:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        lines = fields.byte_strings("i", INVENTORY_MAX, _KEY_BYTES + 9)
        return cls(tuple(_item(line) for line in lines), fields.flag("z"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
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

    statement: bytes
    membership: bytes
    sender: Name
    domain: Name
    via: Name
    transit: tuple[Name, ...]
    lease_s: float
    is_from_upstream: bool
    until_unix_s: int = 0

    def to_fields(self) -> dict[str, object]:
        """Return the entry as a map."""
        return {
            "q": self.statement,
            "m": self.membership,
            "w": self.sender,
            "d": self.domain,
            "v": self.via,
            "x": list(self.transit[:TRANSIT_MAX]),
            "l": float(self.lease_s),
            "u": self.is_from_upstream,
            "t": self.until_unix_s,
        }

    @classmethod
    def from_fields(cls, fields: Fields) -> Entry:
        """Read the map; a malformed one raises ``StatementError``."""
        return cls(
            statement=fields.bytes_("q"),
            membership=fields.bytes_("m"),
            sender=fields.name("w"),
            domain=fields.name("d"),
            via=fields.name("v"),
            transit=tuple(fields.names("x", TRANSIT_MAX)),
            lease_s=fields.number("l", 0, LEASE_MAX_S),
            is_from_upstream=fields.flag("u"),
            until_unix_s=fields.uint("t"),
        )

    @property
    def cost_bytes(self) -> int:
        """Return the bytes that the entry occupies in a statement, at most."""
        return len(self.statement) + len(self.membership) + len(self.transit) * (NAME_BYTES + 2) + _ENTRY_COST_BYTES


@dataclass(frozen=True, slots=True)
class EntryBatch:
    """Entries of one RIB for another, pushed when they are new or fetched."""

    entries: tuple[Entry, ...]
    is_last: bool

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        body = {"e": [entry.to_fields() for entry in self.entries], "z": self.is_last, "c": membership}
        return sign(StatementType.REPLICAS, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> EntryBatch:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        entries = tuple(Entry.from_fields(each) for each in fields.maps("e", ENTRIES_MAX))
        return cls(entries, fields.flag("z"))


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


def _prefix(prefix: bytes) -> bytes:
    if len(prefix) > PREFIX_MAX_BYTES:
        raise StatementError(DropReason.MALFORMED, "a prefix that is too long")
    return prefix


def _item(line: bytes) -> Item:
    name, advertiser = Name(line[:NAME_BYTES]), Name(line[NAME_BYTES:_KEY_BYTES])
    return Item(name, advertiser, int.from_bytes(line[_KEY_BYTES:-1], "big"), line[-1] != 0)
