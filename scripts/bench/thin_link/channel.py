"""Channel: one direction of a thin link, with a rate, a FIFO, a delay and loss, exact in virtual time.

Sans-I/O. A frame passes, in this order::

    FIFO (drop-tail, bytes)  ->  server (rate or trace)  ->  loss  ->  delay  ->  due

A departure is computed when the frame arrives, because a FIFO never changes its order. A lost frame has used the queue
and the rate, as on a radio link. Sizes are bytes after the Ethernet header. Moments are nanoseconds since the start.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random
from typing import Final, TypeAlias

OPPORTUNITY_BYTES: Final = 1_500  # of one line of a trace; mahimahi, NSDI/ATC 2015, section 3.2
_MS_NS: Final = 1_000_000
_SLOT_NS: Final = 100 * _MS_NS


class ConstantRate:
    """Server with one rate, in bits a second."""

    def __init__(self, bits_s: float) -> None:
        self._byte_ns = 8e9 / bits_s
        self._free_ns = 0.0

    def depart_ns(self, ready_ns: int, size: int) -> int:
        """Return when the last bit of a frame leaves; calls come in the order of the frames."""
        self._free_ns = max(self._free_ns, ready_ns) + size * self._byte_ns
        return round(self._free_ns)

    def capacity_bytes(self, begin_ns: int, end_ns: int) -> float:
        """Return how many bytes could leave between two moments, both after the last ``rewind``."""
        return (end_ns - begin_ns) / self._byte_ns

    def rewind(self, now_ns: int) -> None:
        """Do nothing: this server has no recording."""


class TraceRate:
    """Server with recorded opportunities: at each, up to 1,500 bytes of the queue leave; an unused one is lost.

    The recording repeats. Source: mahimahi, Netravali and others, USENIX ATC 2015, section 3.2.

    Args:
        opportunities_ms: milliseconds of the recording, ascending, several may be equal; the last one is its length.

    Raises:
        ValueError: none, or not ascending, or of no length.
    """

    def __init__(self, opportunities_ms: Sequence[int]) -> None:
        if not opportunities_ms or opportunities_ms[-1] <= 0:
            raise ValueError("a trace needs an opportunity after its first millisecond")
        if any(one > other for one, other in pairwise(opportunities_ms)):
            raise ValueError("the moments of a trace must ascend")
        self._moments = list(opportunities_ms)
        self._period_ms = self._moments[-1]
        self._next = 0  # index, over all repetitions, of the opportunity in use
        self._left = OPPORTUNITY_BYTES
        self._begun_ns = 0

    def depart_ns(self, ready_ns: int, size: int) -> int:
        """Return when the last byte of a frame leaves."""
        if self._moment_ns(self._next) < ready_ns:
            self._next, self._left = self._index_from(ready_ns), OPPORTUNITY_BYTES
        while size > self._left:
            size -= self._left
            self._next, self._left = self._next + 1, OPPORTUNITY_BYTES
        self._left -= size
        return self._moment_ns(self._next)

    def capacity_bytes(self, begin_ns: int, end_ns: int) -> float:
        """Return how many bytes could leave between two moments."""
        return float(OPPORTUNITY_BYTES * (self._index_from(end_ns) - self._index_from(begin_ns)))

    def rewind(self, now_ns: int) -> None:
        """Begin the recording again."""
        self._next, self._left, self._begun_ns = 0, OPPORTUNITY_BYTES, now_ns

    def _moment_ns(self, index: int) -> int:
        cycle, at = divmod(index, len(self._moments))
        return self._begun_ns + (cycle * self._period_ms + self._moments[at]) * _MS_NS

    def _index_from(self, moment_ns: int) -> int:
        """Return the first opportunity that is not before a moment."""
        moment_ns -= self._begun_ns
        if moment_ns <= 0:
            return 0
        cycle, rest_ns = divmod(moment_ns - 1, self._period_ms * _MS_NS)  # the end of a repetition belongs to it
        at = bisect_left(self._moments, rest_ns // _MS_NS + 1)
        return cycle * len(self._moments) + at


Rate: TypeAlias = "ConstantRate | TraceRate"


class Loss:
    """Random loss after the Gilbert model: a good state that loses nothing and a bad one that loses all.

    Source: E. N. Gilbert, Capacity of a burst-noise channel, 1960; RFC 6390 terms. A burst of 1 is independent loss.

    Args:
        share: of all frames in the long run, 0 to below 1.
        burst: mean frames lost in a row; at least 1.

    Raises:
        ValueError: a value out of bounds.
    """

    def __init__(self, share: float, burst: float, seed: int) -> None:
        if not 0 <= share < 1 or burst < 1:
            raise ValueError(f"a loss has a share of 0 to 1 and a burst of at least 1, not {share} and {burst}")
        self._seed = seed
        self._random = Random(seed)  # the n-th frame has the same fate in every run with this seed
        self._is_independent = burst == 1
        self._to_good = 1 / burst
        self._to_bad = share if self._is_independent else min(1.0, share * self._to_good / (1 - share))
        self._is_bad = False

    def is_lost(self) -> bool:
        """Return whether the next frame is lost."""
        drawn = self._random.random()
        if self._is_independent:
            return drawn < self._to_bad
        self._is_bad = drawn >= self._to_good if self._is_bad else drawn < self._to_bad
        return self._is_bad

    def rewind(self) -> None:
        """Begin the sequence of fates again."""
        self._random.seed(self._seed)
        self._is_bad = False


@dataclass(slots=True)
class Flow:
    """Frames and bytes of one direction of a link over a span.

    Attributes:
        offered, queue_drops: frames that arrived, and of those, that found the queue full.
        losses, delivered: frames that have left the queue, by their fate.
        delivered_bytes, marked_bytes: of the delivered frames, and of those that the caller marks.
        depth_bytes: highest queue of each tenth of a second in which a frame arrived, in order.
        capacity_bytes: what the link could carry.
    """

    offered: int = 0
    queue_drops: int = 0
    losses: int = 0
    delivered: int = 0
    delivered_bytes: int = 0
    marked_bytes: int = 0
    depth_bytes: list[int] = field(default_factory=list)
    capacity_bytes: float = 0.0

    @property
    def share(self) -> float:
        """Return the bytes that were delivered, of those that the link could carry."""
        return self.delivered_bytes / max(self.capacity_bytes, 1.0)

    @property
    def marked_share(self) -> float:
        """Return the same of the marked frames."""
        return self.marked_bytes / max(self.capacity_bytes, 1.0)


class Channel:
    """One direction of a link; moments of successive calls never decrease.

    ``fifo_bytes``: most bytes that wait or leave; a frame that would exceed them is dropped.
    """

    def __init__(self, rate: Rate, *, delay_ns: int, fifo_bytes: int, loss: Loss) -> None:
        self.rate = rate
        self.counters = Flow()
        self._delay_ns = delay_ns
        self._fifo_bytes = fifo_bytes
        self._loss = loss
        self._waiting = deque[tuple[int, int, bool, bool]]()  # departure, bytes, lost, marked
        self._backlog = 0
        self._slot = -1
        self._taken_ns = 0

    def offer(self, now_ns: int, size: int, *, is_marked: bool = False) -> int | None:
        """Return when a frame that arrived now is due at the far end; None where it is dropped or lost."""
        counters = self.counters
        counters.offered += 1
        backlog = self.backlog_bytes(now_ns) + size
        if backlog > self._fifo_bytes:
            counters.queue_drops += 1
            return None
        departure_ns, is_lost = self.rate.depart_ns(now_ns, size), self._loss.is_lost()
        self._waiting.append((departure_ns, size, is_lost, is_marked))
        self._backlog = backlog
        self._note_depth(now_ns)
        return None if is_lost else departure_ns + self._delay_ns

    def backlog_bytes(self, now_ns: int) -> int:
        """Return the bytes whose last bit has not left, and count the frames that have left."""
        waiting, counters = self._waiting, self.counters
        while waiting and waiting[0][0] <= now_ns:
            _, size, is_lost, is_marked = waiting.popleft()
            self._backlog -= size
            if is_lost:
                counters.losses += 1
                continue
            counters.delivered += 1
            counters.delivered_bytes += size
            if is_marked:
                counters.marked_bytes += size
        return self._backlog

    def rewind(self, now_ns: int) -> None:
        """Begin recording and losses again, so that what follows meets the same link whenever it starts."""
        self.rate.rewind(now_ns)
        self._loss.rewind()

    def take_flow(self, now_ns: int) -> Flow:
        """Return the flow since the last call, and begin new counters."""
        self.backlog_bytes(now_ns)
        taken, self.counters, self._slot = self.counters, Flow(), -1
        taken.capacity_bytes = self.rate.capacity_bytes(self._taken_ns, now_ns)
        self._taken_ns = now_ns
        return taken

    def _note_depth(self, now_ns: int) -> None:
        depths, slot = self.counters.depth_bytes, now_ns // _SLOT_NS
        if slot != self._slot:
            self._slot = slot
            depths.append(self._backlog)
        elif self._backlog > depths[-1]:
            depths[-1] = self._backlog
