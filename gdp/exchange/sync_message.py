"""Message between two nodes that equalise their sets.

Sans-I/O; ``anti_entropy.py`` decides what is sent when.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.schema import FLAG, OCTETS, REASON, Body, Form, Keyed, many, octets, row, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_set import FANOUT, HASH_BYTES, LINE_BYTES, PREFIX_MAX_BYTES
from gdp.names import NAME_BYTES

SETS_MAX: Final = 128
ASKED_MAX: Final = 16  # prefixes in one request, each of which brings 2 KiB
LACKING_MAX: Final = 400
ITEMS_MAX: Final = 64
CAPACITY_BYTES: Final = 11_500  # of hashes, lines or items in one: a statement has at most 16 KiB, a certificate 4
KEY_MAX_BYTES: Final = 2 * NAME_BYTES
_SESSION_BYTES: Final = 16

_SET: Final = octets(most=NAME_BYTES)
_TOTAL: Final[Form[tuple[bytes, bytes]]] = row(lambda *each: each, _SET, octets(HASH_BYTES))
_HASHES: Final[Form[tuple[bytes, bytes]]] = row(
    lambda *each: each, octets(most=PREFIX_MAX_BYTES - 1), octets(FANOUT * HASH_BYTES)
)
_LACKING: Final[Form[tuple[bytes, bytes]]] = row(lambda *each: each, octets(most=KEY_MAX_BYTES), OCTETS)


@dataclass(frozen=True, slots=True, kw_only=True)
class SyncMessage(Body):
    """What one node has of some sets, what it asks for, and items.

    Args:
        of: the set that the other fields but ``totals`` are about; empty: none.
        totals: each set that the sender compares, and the hash over it, 8 bytes.
        hashes: a prefix of keys, and the 256 hashes below it, 8 bytes each.
        asked: prefixes below which the sender requests the hashes.
        lacking: a prefix below which the sender requests items, and a line of 17 bytes for each that it has there.
        items: as the protocol that owns the set writes them.
        is_last: the reply to a request ends.
        rest: how many prefixes at the end of ``lacking`` of the request the reply leaves out, for its size.
        refused: why the receiver's last item was refused; None: it was not.
        session: echo of the receiver's port; empty in a channel, which has sessions of its own.
        sequence: rises with every message of the sender in a session.
    """

    TYPE = StatementType.SYNC
    of: Annotated[bytes, Keyed("d", _SET)] = b""
    totals: Annotated[tuple[tuple[bytes, bytes], ...], Keyed("w", many(_TOTAL, SETS_MAX), (), is_omitted=True)] = ()
    hashes: Annotated[tuple[tuple[bytes, bytes], ...], Keyed("h", many(_HASHES, ASKED_MAX), (), is_omitted=True)] = ()
    asked: Annotated[
        tuple[bytes, ...], Keyed("p", many(octets(most=PREFIX_MAX_BYTES - 1), ASKED_MAX), (), is_omitted=True)
    ] = ()
    lacking: Annotated[
        tuple[tuple[bytes, bytes], ...], Keyed("l", many(_LACKING, LACKING_MAX), (), is_omitted=True)
    ] = ()
    items: Annotated[tuple[bytes, ...], Keyed("e", many(OCTETS, ITEMS_MAX), (), is_omitted=True)] = ()
    is_last: Annotated[bool, Keyed("z", FLAG, False, is_omitted=True)] = False
    rest: Annotated[int, Keyed("r", uint(LACKING_MAX), 0, is_omitted=True)] = 0
    refused: Annotated[DropReason | None, Keyed("x", REASON, None, is_omitted=True)] = None
    session: Annotated[bytes, Keyed("i", octets(_SESSION_BYTES), b"", is_omitted=True)] = b""
    sequence: Annotated[int, Keyed("s", uint(), 0, is_omitted=True)] = 0

    def check(self) -> None:
        """Return if the lines are whole ones. Raises ``StatementError``: MALFORMED."""
        if any(len(lines) % LINE_BYTES for _, lines in self.lacking):
            raise StatementError(DropReason.MALFORMED, "lines of a request")


def pages(items: Iterable[bytes]) -> Iterator[tuple[bytes, ...]]:
    """Yield items in groups that fit one message each; an item that fits none is left out."""
    group: list[bytes] = []
    size = 0
    for item in items:
        if len(item) > CAPACITY_BYTES:
            continue
        if group and (size + len(item) > CAPACITY_BYTES or len(group) >= ITEMS_MAX):
            yield tuple(group)
            group, size = [], 0
        group.append(item)
        size += len(item)
    if group:
        yield tuple(group)
