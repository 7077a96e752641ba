"""Recovery of lost frames from parity, at the reader of one writer.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/loss.md.

The frames of unfinished messages whose flag announces parity are kept as they came. When a block has enough of them,
with its parity, the lost frames are rebuilt. They then take the way of frames that came: their seals are checked there,
so wrong parity costs the block, and delivers nothing wrong.

A gap is not requested while its parity may be under way. This wait ends with the last parity frame, or when more is
missing than parity can fill. A pause of the writer ends it, too, and ``WAIT_MAX_S`` in any case.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from gdp.crypto.envelope import SHARED_FLAGS
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import FLAGS_AT, Flag, Header, decode
from gdp.intervals import NEVER_S
from gdp.limits import RECOVERY_BYTES
from gdp.message import erasure
from gdp.message.parity import Block, Parity, blocks_of, frame_of, shard_of, span_of
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.sansio import ReceivedFrame

WAIT_MAX_S: Final = 0.25  # for parity, from when a gap was found
_QUIET_S, _QUIET_MAX_S = 0.020, 0.060  # a pause of the writer after which no more parity is awaited
_QUIET_FRAMES: Final = 4  # ... or the usual time of so many frames
_FORGET_S: Final = 1.0
_MESSAGES_MAX: Final = 16
_OVERHEAD_BYTES: Final = 128  # of a kept frame, in addition to its bytes
_PARITY: Final = int(Flag.PARITY)


@dataclass(slots=True, kw_only=True)
class _Protected:
    """Unfinished message with parity."""

    header: Header  # of one of its frames
    begun_s: float
    last_s: float
    came: int = 0
    held_bytes: int = 0
    deferred_s: float | None = None  # since when a gap waits for parity
    frames: dict[int, bytes] = field(default_factory=dict)  # by part, without complete spans
    in_span: Counter[int] = field(default_factory=Counter)  # parts that are here, by the first part of their span
    counts: dict[int, int] = field(default_factory=dict)  # parity shards of a block, by span
    places: dict[int, int] = field(default_factory=dict)  # of the last parity frame in the order of sending, by span
    shards: dict[tuple[int, int], dict[int, bytes]] = field(default_factory=dict)  # by block and size: index -> shard
    decoded: set[int] = field(default_factory=set)  # blocks, by their first part


class FrameRecovery:
    """Recovery of the lost frames of one writer.

    Args:
        source: name whose quota is charged.
        budget: shared by all reassemblers of the node.

    Attributes:
        recovered: frames that were rebuilt, and fit.
        unfinished_bytes: memory that the kept frames hold.
        messages: unfinished ones, by number.
    """

    def __init__(self, source: bytes, budget: ReassemblyQuota) -> None:
        self._source = source
        self._budget = budget
        self._is_enabled = erasure.is_available()
        self.messages: dict[int, _Protected] = {}
        self.unfinished_bytes = 0
        self.recovered = 0
        budget.register(self, source)

    def give_way(self) -> None:
        """Forget the message that is needed last, because reassembly needs the memory."""
        if self.messages:
            self.forget(max(self.messages))

    def keep(self, header: Header, frame: bytes, now_s: float) -> None:
        """Keep a new frame of an unfinished message, if its flags announce parity, as far as memory allows."""
        if header.flags & _PARITY and self._is_enabled:
            self._keep(self._message(header, now_s), header.part, frame, now_s)

    def keep_run(self, arrivals: Sequence[ReceivedFrame], at: int, count: int, now_s: float) -> None:
        """Keep ``count`` frames of one message, of consecutive parts, from ``arrivals[at]`` on."""
        if not arrivals[at].frame[FLAGS_AT] & _PARITY or not self._is_enabled:
            return
        header = decode(arrivals[at].frame)
        message = self._message(header, now_s)
        for part, arrival in enumerate(arrivals[at : at + count], header.part):
            self._keep(message, part, arrival.frame, now_s)

    def add_parity(self, header: Header, body: bytes, now_s: float) -> list[bytes]:
        """Add an authentic parity frame; return the frames that it restores.

        Raises:
            EnvelopeError: UNUSED_PARITY, nothing lacks it; MALFORMED, it does not fit its message; MEMORY_FULL.
        """
        parity, message = Parity.from_wire(body), self.messages.get(header.number)
        if message is None:
            raise EnvelopeError(DropReason.UNUSED_PARITY, "no frame of its message is kept")
        parts = message.header.parts
        span = span_of(parity.first, parts)
        blocks = blocks_of(span)
        if header.parts != parts or not 0 <= parity.first - span.start < len(blocks):
            raise EnvelopeError(DropReason.MALFORMED, "parity of another block")
        block = blocks[parity.first - span.start]
        message.last_s = now_s
        message.counts[span.start] = parity.count
        place = parity.index * len(blocks) + parity.first - span.start
        message.places[span.start] = max(message.places.get(span.start, -1), place)
        group = message.shards.setdefault((block.first, len(parity.shard)), {})
        lacking = self._lacking(message, block)
        if not lacking or block.first in message.decoded or parity.index in group:
            raise EnvelopeError(DropReason.UNUSED_PARITY, "its block is complete")
        if not self._reserve(message, len(parity.shard)):
            raise EnvelopeError(DropReason.MEMORY_FULL, "parity")
        group[parity.index] = parity.shard
        return self._rebuild(message, block, group) if len(group) >= len(lacking) else []

    def awaited_s(self, number: int, now_s: float) -> float:
        """Return the monotonic second until which parity may fill what lacks of a message; 0: none is awaited."""
        message = self.messages.get(number)
        if message is None:
            return 0.0
        if message.deferred_s is None:
            message.deferred_s = now_s
        usual_s = (message.last_s - message.begun_s) / message.came
        quiet_s = min(max(_QUIET_FRAMES * usual_s, _QUIET_S), _QUIET_MAX_S)
        until_s = min(message.last_s + quiet_s, message.deferred_s + WAIT_MAX_S)
        return until_s if now_s < until_s and not self._is_hopeless(message) else 0.0

    def forget(self, number: int) -> None:
        """Release what is kept of a message."""
        message = self.messages.pop(number, None)
        if message is not None:
            self._release(message, message.held_bytes)

    def forget_below(self, number: int) -> None:
        """Release what is kept of messages under a number."""
        for each in [each for each in self.messages if each < number]:
            self.forget(each)

    def drop_expired(self, now_s: float) -> None:
        """Release messages of which nothing came for a second: they are repaired, or given up."""
        for number in [n for n, message in self.messages.items() if now_s - message.last_s >= _FORGET_S]:
            self.forget(number)

    def next_expiry(self) -> float:
        """Return the monotonic second at which ``drop_expired`` has something to do; infinity: none."""
        if not self.messages:
            return NEVER_S
        return min(message.last_s for message in self.messages.values()) + _FORGET_S

    def close(self) -> None:
        """Release everything."""
        for number in list(self.messages):
            self.forget(number)

    def _message(self, header: Header, now_s: float) -> _Protected:
        number, message = header.number, self.messages.get(header.number)
        if message is not None and not _is_same(message.header, header):
            self.forget(number)  # of two forms of one message, the later one holds
            message = None
        if message is None:
            while len(self.messages) >= _MESSAGES_MAX:
                self.forget(min(self.messages))
            message = self.messages[number] = _Protected(header=header, begun_s=now_s, last_s=now_s)
        return message

    def _keep(self, message: _Protected, part: int, frame: bytes, now_s: float) -> None:
        message.last_s = now_s
        message.came += 1
        span = span_of(part, message.header.parts)
        is_here = part in message.frames or message.in_span[span.start] == len(span)
        if is_here or not self._reserve(message, len(frame)):
            return
        message.frames[part] = frame
        message.in_span[span.start] += 1
        if message.in_span[span.start] == len(span):
            self._release(message, sum(len(message.frames.pop(each)) + _OVERHEAD_BYTES for each in span))

    def _lacking(self, message: _Protected, block: Block) -> list[int]:
        """Return the parts of a block that are not here."""
        span = span_of(block.first, message.header.parts)
        if message.in_span[span.start] == len(span):
            return []
        return [part for part in block.parts if part not in message.frames]

    def _rebuild(self, message: _Protected, block: Block, parity: dict[int, bytes]) -> list[bytes]:
        """Return the lost frames of a block, which is not decoded again."""
        message.decoded.add(block.first)
        message.deferred_s = None
        size = len(next(iter(parity.values())))
        try:
            shards = {
                place: shard_of(message.frames[part], size)
                for place, part in enumerate(block.parts)
                if part in message.frames
            }
            restored = erasure.decode(shards, parity, block.size)
            header = message.header
            return [frame_of(header, block.parts[place], shard) for place, shard in restored.items()]
        finally:
            self._release(message, sum(len(each) + _OVERHEAD_BYTES for each in parity.values()))
            parity.clear()

    def _is_hopeless(self, message: _Protected) -> bool:
        """Return whether parity has come, and what may still come cannot fill some block."""
        for first, count in message.counts.items():
            span = span_of(first, message.header.parts)
            blocks, place = blocks_of(span), message.places[first]
            for at, block in enumerate(blocks):
                lacking = len(self._lacking(message, block))
                here = max((len(group) for (of, _), group in message.shards.items() if of == block.first), default=0)
                coming = sum(index * len(blocks) + at > place for index in range(count))
                if lacking > (0 if block.first in message.decoded else here + coming):
                    return True
        return False

    def _reserve(self, message: _Protected, size: int) -> bool:
        cost = size + _OVERHEAD_BYTES
        if self.unfinished_bytes + cost > RECOVERY_BYTES or not self._budget.reserve(self._source, cost):
            return False
        self.unfinished_bytes += cost
        message.held_bytes += cost
        return True

    def _release(self, message: _Protected, size: int) -> None:
        self.unfinished_bytes -= size
        message.held_bytes -= size
        self._budget.release(self._source, size)


def _is_same(a: Header, b: Header) -> bool:
    """Return whether two frames may be of one message."""
    return (a.parts, a.epoch, a.flags & SHARED_FLAGS) == (b.parts, b.epoch, b.flags & SHARED_FLAGS)
