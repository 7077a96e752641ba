"""Lost messages: which ones, how many, and why.

Sans-I/O. Sequence numbers identify messages. A publisher numbers each message of its incarnation, sent or not, so a gap
between two numbers is exactly what was lost.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

RANGES_MAX: Final = 64  # latest ranges that are kept; the counts go on
GONE_MAX: Final = 16  # ranges that a publisher repeats to its readers with their reason
_SET_MAX: Final = 1_024


class LossReason(IntEnum):
    """Why a reader did not get a message.

    The value is on the wire and the label in metrics and JSON, so new reasons are only ever appended.
    """

    GAP = 1  # lost on the path, on a best-effort topic
    GIVEN_UP = 2  # no longer cached for a reader that was silent, or behind the others, for too long
    WINDOW_OVERFLOW = 3  # evicted from the publisher's full window, or refused because the window was full
    QUEUE_OVERFLOW = 4  # evicted from the publisher's full queue, on a best-effort topic
    NO_READER = 5  # published while its publisher knew of no reader
    TOO_LARGE = 6  # above the limit of its rule
    READER_MEMORY = 7  # the reader had no memory left to wait for it
    PUBLISHER_RESTARTED = 8  # its publisher started again in between
    READER_RESTARTED = 9  # this reader restarted
    DETACHED = 10  # the route to the publisher was gone in between
    LIFESPAN = 11  # it could not leave its publisher in time, on a best-effort topic
    CALL_ENDED = 12  # a request whose call ended before it was complete here
    THINNED = 13  # for faster readers: it is behind a link that does not carry every message

    @property
    def label(self) -> str:
        """Return the word used in metrics and JSON, such as ``window-overflow``."""
        return self.name.lower().replace("_", "-")


class LostRange(NamedTuple):
    """Messages ``first`` to ``last``, both included, by sequence number."""

    first: int
    last: int
    reason: LossReason

    @property
    def messages(self) -> int:
        """Return the number of messages."""
        return self.last - self.first + 1


class Losses:
    """What was lost: the count of messages for each reason, and the latest ranges."""

    def __init__(self) -> None:
        self.counts: Counter[LossReason] = Counter()
        self.ranges: deque[LostRange] = deque(maxlen=RANGES_MAX)

    @property
    def total(self) -> int:
        """Return how many messages were lost."""
        return sum(self.counts.values()) if self.counts else 0

    def add(self, lost: LostRange) -> None:
        """Count a range; one that continues the latest is joined to it."""
        self.counts[lost.reason] += lost.messages
        append(self.ranges, lost)

    def update(self, other: Losses) -> None:
        """Add the losses that another object has counted."""
        self.counts += other.counts
        self.ranges.extend(other.ranges)

    def by_label(self) -> dict[str, int]:
        """Return the counts that are not 0, as JSON names them."""
        return {label: count for label, count in by_label(self.counts).items() if count}

    def words(self) -> str:
        """Return the total and its composition, such as ``5 lost (gap 3, given-up 2)``."""
        reasons = ", ".join(f"{label} {count}" for label, count in self.by_label().items())
        return f"{self.total} lost ({reasons})" if reasons else "0 lost"

    def to_fields(self) -> list[dict[str, object]]:
        """Return the latest ranges as JSON objects."""
        return [
            {"first": each.first, "last": each.last, "messages": each.messages, "reason": each.reason.label}
            for each in self.ranges
        ]


def by_label(counts: Mapping[LossReason, int]) -> dict[str, int]:
    """Return counts of messages as metrics name them, one for every reason."""
    return {reason.label: counts.get(reason, 0) for reason in LossReason}


class RangeSet:
    """A set of sequence numbers as disjoint ranges. Of too many ranges the lowest are only counted."""

    def __init__(self) -> None:
        self._ranges: list[tuple[int, int]] = []
        self._counted = 0

    def add(self, first: int, last: int) -> None:
        """Add numbers ``first`` to ``last``, both included."""
        begin = bisect_left(self._ranges, first - 1, key=lambda each: each[1])
        end = begin
        while end < len(self._ranges) and self._ranges[end][0] <= last + 1:
            first, last = min(first, self._ranges[end][0]), max(last, self._ranges[end][1])
            end += 1
        self._ranges[begin:end] = [(first, last)]
        if len(self._ranges) > _SET_MAX:
            lowest = self._ranges.pop(0)
            self._counted += lowest[1] - lowest[0] + 1

    def count_below(self, end: int) -> int:
        """Return how many numbers below ``end`` there are."""
        return self._counted + sum(min(last, end - 1) - first + 1 for first, last in self._ranges if first < end)


def append(ranges: deque[LostRange], lost: LostRange) -> None:
    """Append a range, or extend the latest by it."""
    if ranges and ranges[-1].reason is lost.reason and ranges[-1].last + 1 == lost.first:
        lost = LostRange(ranges.pop().first, lost.last, lost.reason)
    ranges.append(lost)


def explain(first: int, last: int, known: Iterable[LostRange], otherwise: LossReason) -> Sequence[LostRange]:
    """Return the numbers ``first`` to ``last`` as ranges, each with its reason as far as that is known.

    Args:
        known: disjoint ranges, in any order.
        otherwise: the reason of numbers outside ``known``.
    """
    found: list[LostRange] = []
    at = first
    for each in sorted(known):
        begin, end = max(each.first, at), min(each.last, last)
        if begin > end:
            continue
        if at < begin:
            found.append(LostRange(at, begin - 1, otherwise))
        found.append(LostRange(begin, end, each.reason))
        at = end + 1
    if at <= last:
        found.append(LostRange(at, last, otherwise))
    return found
