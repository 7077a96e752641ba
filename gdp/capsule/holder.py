"""Requests to a holder of capsules, and its answers: the body of a call of its service.

Sans-I/O. Both are maps in deterministic CBOR. Offsets count bytes of records from the first record of a capsule on.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Final

from gdp.capsule.descriptor import Descriptor
from gdp.crypto.schema import NAME_OR_ZERO, FieldSet, Keyed, inner, many, octets, one_of, uint
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.names import ZERO, Name

BATCH_BYTES: Final = 512 << 10  # of records in one request or answer
LISTED_MAX: Final = 1_024
SYNCED_MAX: Final = 64  # capsules that one request finds different


class Ask(str, Enum):
    """What a request asks for."""

    HEAD = "head"
    APPEND = "append"  # records at an offset; a repetition changes nothing
    READ = "read"
    LIST = "list"
    MARKS = "marks"  # the latest ones, as records
    SYNC = "sync"  # ``data``: the total of what the client holds, or lines of it (``gdp/exchange/sync_set.py``)


@dataclass(frozen=True, slots=True, kw_only=True)
class HolderRequest(FieldSet):
    """Request to a holder.

    Attributes:
        capsule: its name.
        offset: where ``data`` begins, or what is read.
        time_ns: read from the last checkpoint at or before this time on; 0: from ``offset`` on.
        data: records to append.
        gap: bytes before them that the client left out, or has no more.
        descriptor: of a capsule that the holder may not know.
        topic: list capsules of this topic alone; zeros: all.
    """

    MAX_BYTES = MESSAGE_MAX_BYTES
    ask: Annotated[Ask, Keyed("ask", one_of(Ask))]
    capsule: Annotated[Name, Keyed("capsule", NAME_OR_ZERO, absent=ZERO, is_omitted=True)] = ZERO
    offset: Annotated[int, Keyed("offset", uint(), absent=0, is_omitted=True)] = 0
    time_ns: Annotated[int, Keyed("time", uint(), absent=0, is_omitted=True)] = 0
    data: Annotated[bytes, Keyed("data", octets(most=2 * BATCH_BYTES), absent=b"", is_omitted=True)] = b""
    gap: Annotated[int, Keyed("gap", uint(), absent=0, is_omitted=True)] = 0
    descriptor: Annotated[Descriptor | None, Keyed("descriptor", inner(Descriptor), absent=None, is_omitted=True)] = (
        None
    )
    topic: Annotated[Name, Keyed("topic", NAME_OR_ZERO, absent=ZERO, is_omitted=True)] = ZERO


@dataclass(frozen=True, slots=True, kw_only=True)
class HolderAnswer(FieldSet):
    """Answer of a holder.

    Attributes:
        head: behind the last byte that is on its disk, or in its bucket: confirmed.
        offset: what is to be appended next; of records that were read, where they begin: as asked, or behind a gap.
        data: records, or a part of the last one; the holder's total.
        described: the records with the topics' descriptions that hold where ``data`` begins, if records are skipped.
        descriptors: of the listed capsules, or of those that the client lacks in part.
    """

    MAX_BYTES = MESSAGE_MAX_BYTES
    head: Annotated[int, Keyed("head", uint(), absent=0, is_omitted=True)] = 0
    offset: Annotated[int, Keyed("offset", uint(), absent=0, is_omitted=True)] = 0
    data: Annotated[bytes, Keyed("data", octets(most=2 * BATCH_BYTES), absent=b"", is_omitted=True)] = b""
    described: Annotated[bytes, Keyed("described", octets(most=BATCH_BYTES), absent=b"", is_omitted=True)] = b""
    descriptors: Annotated[
        tuple[Descriptor, ...],
        Keyed("descriptors", many(inner(Descriptor), LISTED_MAX), absent=(), is_omitted=True),
    ] = ()
