"""Fragmentation and reassembly of control statements.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Statements are signed, not sealed. Until one is complete, its
author is unproven. So memory is bounded per source and in all, and the timeout is short. At a bound, the oldest
unfinished statement is evicted. A flood of first fragments therefore evicts its own, and hardly a statement whose
fragments arrive at once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from gdp.errors import DropReason, FrameError, LocalError
from gdp.frame.codec import HEADER_BYTES, Flag, Header, encode
from gdp.limits import (
    CONTROL_JOIN_BYTES,
    CONTROL_JOIN_SOURCE_BYTES,
    CONTROL_MAX_BYTES,
    CONTROL_PARTS_MAX,
    CONTROL_PATIENCE_S,
    HOPS_MAX,
    MTU_MIN_BYTES,
    RECORD_OVERHEAD_BYTES,
)
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.names import ZERO

_COST_BYTES: Final = 200  # overhead of an unfinished statement, in addition to its bytes
_FAR_MTU: Final = MTU_MIN_BYTES  # behind the first link there may be a tunnel, or any link there may be

_Key = tuple[bytes, int, int, int]  # origin, kind, incarnation, number


class ControlFragmenter:
    """Numbering and fragmentation of the statements of one node."""

    def __init__(self, source: bytes, incarnation: int) -> None:
        self._source = source
        self._incarnation = incarnation
        self._number = 0

    def split(self, kind: int, statement: bytes, mtu: int, destination: bytes = ZERO) -> list[bytes]:
        """Return the frames of a statement.

        Args:
            mtu: bytes after the Ethernet header on the first link. A statement that goes further than a neighbour is
                split for the smallest supported link.
            destination: zero for the neighbour itself.

        Raises:
            LocalError: a statement above the limit.
        """
        capacity = (mtu if destination == ZERO else min(mtu, _FAR_MTU)) - HEADER_BYTES
        chunks = [statement[at : at + capacity] for at in range(0, len(statement), capacity)] or [b""]
        if len(statement) > CONTROL_MAX_BYTES + RECORD_OVERHEAD_BYTES or len(chunks) > CONTROL_PARTS_MAX:
            raise LocalError(f"a statement of {len(statement)} bytes is above the limit")
        self._number += 1
        header = Header(
            kind, 0, HOPS_MAX, 0, 0, self._number, 0, len(chunks), self._incarnation, destination, self._source
        )
        return [
            encode(header._replace(part=part, length=len(chunk), flags=Flag.LAST if part == len(chunks) - 1 else 0))
            + chunk
            for part, chunk in enumerate(chunks)
        ]


@dataclass(slots=True)
class _PartialStatement:
    parts: int
    begun_s: float
    chunks: dict[int, bytes] = field(default_factory=dict)
    held_bytes: int = _COST_BYTES


class ControlReassembler:
    """Reassembly of statements of any source.

    Attributes:
        unfinished: the unfinished statements, keyed by (origin, kind, incarnation, number).
    """

    def __init__(self) -> None:
        self._budget = ReassemblyQuota(CONTROL_JOIN_BYTES, CONTROL_JOIN_SOURCE_BYTES)
        self.unfinished: dict[_Key, _PartialStatement] = {}
        self._by_source: dict[bytes, dict[_Key, None]] = {}  # in order of their first fragment
        self.drops: Counter[DropReason] = Counter()

    @property
    def held_bytes(self) -> int:
        """Return how much memory unfinished statements hold."""
        return self._budget.held_bytes

    def add(self, header: Header, frame: bytes, now_s: float, via: bytes = b"") -> bytes | None:
        """Add a fragment; return the statement when it is complete.

        Args:
            via: neighbour and port that it came from. With the source it makes the origin. Each origin has its own
                memory, and only fragments of one origin are joined: a stranger on the link cannot corrupt a neighbour's
                statement.

        Raises:
            FrameError: it cannot be a fragment of a statement.
        """
        payload = frame[HEADER_BYTES : HEADER_BYTES + header.length]
        if header.parts == 1:
            return payload
        if header.parts > CONTROL_PARTS_MAX:
            raise FrameError(DropReason.BAD_PARTS, f"a statement in {header.parts} parts")
        self.drop_expired(now_s)
        origin = header.source + via
        key = (origin, header.kind, header.incarnation, header.number)
        waiting = self.unfinished.get(key)
        if waiting is None:
            self._reserve(origin, _COST_BYTES)
            waiting = self.unfinished[key] = _PartialStatement(header.parts, now_s)
            self._by_source.setdefault(origin, {})[key] = None
        if waiting.parts != header.parts:
            raise FrameError(DropReason.BAD_PARTS, "the number of parts changed")
        if header.part in waiting.chunks:
            raise FrameError(DropReason.DUPLICATE, "statement")
        if waiting.held_bytes + len(payload) > CONTROL_MAX_BYTES + RECORD_OVERHEAD_BYTES + _COST_BYTES:
            self._drop(key)
            raise FrameError(DropReason.TOO_BIG, "statement")
        self._reserve(origin, len(payload))
        if key not in self.unfinished:  # it was the oldest itself
            self._budget.release(origin, len(payload))
            raise FrameError(DropReason.MEMORY_FULL, "statements")
        waiting.held_bytes += len(payload)
        waiting.chunks[header.part] = payload
        if len(waiting.chunks) < waiting.parts:
            return None
        self._drop(key)
        return b"".join(waiting.chunks[part] for part in range(waiting.parts))

    def drop_expired(self, now_s: float) -> None:
        """Drop statements that waited longer than ``CONTROL_PATIENCE_S``."""
        while self.unfinished:
            key, oldest = next(iter(self.unfinished.items()))
            if now_s - oldest.begun_s < CONTROL_PATIENCE_S:
                break
            self._drop(key)
            self.drops[DropReason.ABANDONED] += 1

    def _reserve(self, source: bytes, size: int) -> None:
        """Reserve memory; where none is left, evict the oldest statement of this source or of all."""
        while not self._budget.reserve(source, size):
            mine = self._by_source.get(source)
            held = sum(self.unfinished[key].held_bytes for key in mine or ())
            is_mine = held + size > CONTROL_JOIN_SOURCE_BYTES
            self._drop(next(iter(mine if mine and is_mine else self.unfinished)))
            self.drops[DropReason.MEMORY_FULL] += 1

    def _drop(self, key: _Key) -> None:
        source = key[0]
        self._budget.release(source, self.unfinished.pop(key).held_bytes)
        del self._by_source[source][key]
        if not self._by_source[source]:
            del self._by_source[source]
