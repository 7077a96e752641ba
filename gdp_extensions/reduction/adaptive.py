"""Adaptive quality: rate and JPEG quality of one topic, as the path carries them, between stated bounds.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

The controller keeps an estimate of the bytes a second that the path gives this topic. It is what the path's congestion
control says, where the caller knows that. Otherwise it follows additive increase and multiplicative decrease: messages
that wait or are dropped lower it to a share of the rate at which the path served them, and quiet seconds raise it. From
the estimate and the size of messages follow quality and rate: quality falls first, down to its minimum, then the rate
does. Both fall at once and recover slowly. A message is sent only while so little is on its way that it will not wait,
so that the newest picture is fresh.

    backlog of the path   | estimate      | quality, rate
    ----------------------|---------------|----------------------------------------
    late or dropped       | x 0.8 at once | fall at once
    in time for 2 s       | + 8 %/s       | rise with it, quality last
    ... near the estimate |               |
    that was too much     | + 1 %/s       |

Source of the scheme: D.-M. Chiu, R. Jain, "Analysis of the increase and decrease algorithms for congestion avoidance",
1989; of one message in flight per period: the "latest value" rule of video conferencing (RFC 8836, section 2).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from proxy.config.reduction import MIN_HZ, MIN_QUALITY, QUALITY

_LATE_S: Final = 0.1  # longest wait that is no sign of a backlog, beyond the shortest wait seen lately
_DECREASE: Final = 0.8
_INCREASE_PER_S: Final = 0.08
_PROBE_PER_S: Final = 0.01  # increase near the estimate that was too much
_NEAR: Final = 0.85  # share of it from which on the increase is slow
_USE: Final = 0.9  # share of the estimate that is used
_RECENT_S: Final = 2.0  # for which departures are kept, and after a decrease until the estimate rises
_BASE_S: Final = 30.0  # over which the shortest wait is kept: the path may change
_QUALITY_PER_S: Final = 10.0  # most points of quality that are regained in a second
_SIZE_WEIGHT: Final = 0.25  # of the newest message in the mean size
_RATE_WEIGHT: Final = 0.1  # of the newest gap in the mean gap of offered messages
_EARLY: Final = 0.5  # of a period: no clock is exact
# Bytes of a JPEG by quality, relative to quality 80, on recorded 640x480 frames.
_SIZES: Final = (
    (1, 0.17),
    (10, 0.24),
    (30, 0.41),
    (50, 0.56),
    (70, 0.78),
    (80, 1.0),
    (90, 1.56),
    (95, 2.4),
    (100, 5.6),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptBounds:
    """Bounds of the controller.

    Attributes:
        max_hz: None: as often as messages come.
        has_quality: whether a lower quality makes messages smaller; False: only the rate adapts.
    """

    min_hz: float = MIN_HZ
    max_hz: float | None = None
    min_quality: int = MIN_QUALITY
    max_quality: int = QUALITY
    has_quality: bool = True


class AdaptiveQuality:
    """Controller of one topic.

    Attributes:
        quality: JPEG quality of the next message.
        rate_hz: messages a second that may leave; infinite while nothing bounds it.
    """

    __slots__ = (
        "_base_s",
        "_bounds",
        "_ceiling",
        "_estimate",
        "_gap_s",
        "_in_flight",
        "_left",
        "_lowered_s",
        "_next_s",
        "_offered_s",
        "_path_bytes_s",
        "_raised_s",
        "_size",
        "_updated_s",
        "_waits",
        "quality",
        "rate_hz",
    )

    def __init__(self, bounds: AdaptBounds) -> None:
        self._bounds = bounds
        self.quality = bounds.max_quality
        self.rate_hz = float("inf") if bounds.max_hz is None else bounds.max_hz
        self._estimate = float("inf")  # bytes a second; infinite until the path shows a limit
        self._ceiling = float("inf")  # the estimate that was too much
        self._path_bytes_s: float | None = None
        self._size = 0.0  # mean bytes of a message, as of quality 80
        self._gap_s: float | None = None  # mean time between offered messages
        self._offered_s: float | None = None
        self._next_s = float("-inf")
        self._updated_s: float | None = None
        self._raised_s = float("-inf")
        self._lowered_s = float("-inf")
        self._in_flight = deque[tuple[int, float]]()  # bytes, second of sending
        self._left = deque[tuple[float, int]]()  # second of departure, bytes
        self._waits = deque[tuple[float, float]]()  # second, wait: rising waits, of the last _BASE_S
        self._base_s = 0.0

    def may_send(self, now_s: float, path_bytes_s: float | None = None) -> bool:
        """Return whether a message that comes now may leave; True counts it against the rate.

        Args:
            path_bytes_s: bytes a second that the path gives this topic, as its congestion control knows; None: unknown.
        """
        self._measure_gap(now_s)
        self._path_bytes_s = path_bytes_s
        self._recover(now_s)
        self._choose(now_s)
        if self._is_backed_up(now_s):
            return False
        if self.rate_hz == float("inf"):
            return True
        period_s = 1 / self.rate_hz
        if now_s < self._next_s:
            return False
        self._next_s = max(self._next_s + period_s, now_s + _EARLY * period_s)
        return True

    def handle_sent(self, size_bytes: int, now_s: float) -> None:
        """Count a message that was handed to the path, made with the present quality."""
        self._in_flight.append((size_bytes, now_s))
        size = size_bytes / _size_of(self.quality) if self._bounds.has_quality else float(size_bytes)
        self._size = size if not self._size else self._size + _SIZE_WEIGHT * (size - self._size)

    def handle_left(self, waited_s: float, now_s: float) -> None:
        """Count the oldest message on its way as gone: it has left this machine, or readers have confirmed it.

        Args:
            waited_s: seconds since ``handle_sent``, as far as they are proven.
        """
        if not self._in_flight:
            return
        size_bytes, sent_s = self._in_flight.popleft()
        self._left.append((now_s, size_bytes))
        while self._left[0][0] < now_s - _RECENT_S:
            self._left.popleft()
        self._base_s = self._shortest(waited_s, now_s)
        if waited_s > self._base_s + self._late_s:
            self._lower(self._served_bytes_s(sent_s, 0, now_s), sent_s, now_s)

    def handle_dropped(self, count: int, now_s: float) -> None:
        """Count messages that the path dropped: the oldest on their way."""
        for _ in range(min(count, len(self._in_flight))):
            _, sent_s = self._in_flight.popleft()
            self._lower(self._served_bytes_s(min(sent_s, now_s - _RECENT_S), 0, now_s), sent_s, now_s)

    def handle_refused(self, now_s: float) -> None:
        """Count a message that the path had no space for."""
        since_s = self._in_flight[0][1] if self._in_flight else now_s - _RECENT_S
        self._lower(self._served_bytes_s(since_s, 0, now_s), since_s, now_s)

    @property
    def estimate_bytes_s(self) -> float:
        """Return the bytes a second that the path is thought to give this topic; infinite: no limit has shown."""
        return self._estimate if self._path_bytes_s is None else self._path_bytes_s

    @property
    def _late_s(self) -> float:
        """Return the wait beyond the shortest that shows a backlog: a message takes its own time to leave."""
        own_s = self._size_at(self.quality) / self.estimate_bytes_s if self._size else 0.0
        return max(_LATE_S, own_s)

    def _is_backed_up(self, now_s: float) -> bool:
        """Return whether a message sent now would wait for earlier ones longer than ``_LATE_S``."""
        if not self._in_flight:
            return False
        size_bytes, oldest_s = self._in_flight[0]
        if now_s - oldest_s > self._base_s + 2 * self._late_s:
            self._lower(self._served_bytes_s(oldest_s, size_bytes, now_s), oldest_s, now_s)
        estimate = self.estimate_bytes_s
        if estimate == float("inf"):
            return now_s - oldest_s > self._base_s + self._late_s
        return sum(size for size, _ in self._in_flight) > estimate * (self._base_s + _LATE_S)

    def _measure_gap(self, now_s: float) -> None:
        if self._offered_s is not None:
            gap_s = now_s - self._offered_s
            self._gap_s = gap_s if self._gap_s is None else self._gap_s + _RATE_WEIGHT * (gap_s - self._gap_s)
        self._offered_s = now_s

    def _recover(self, now_s: float) -> None:
        """Raise the estimate while nothing is late."""
        elapsed_s = 0.0 if self._updated_s is None else now_s - self._updated_s
        self._updated_s = now_s
        if now_s - self._lowered_s < _RECENT_S or self._estimate == float("inf"):
            return
        is_near = _NEAR * self._ceiling < self._estimate < self._ceiling
        self._estimate *= 1 + (_PROBE_PER_S if is_near else _INCREASE_PER_S) * min(elapsed_s, 1.0)
        if self._size and self._estimate > 4 * self._wanted_bytes_s():
            self._estimate = float("inf")  # all fits many times: the estimate says nothing more

    def _lower(self, served_bytes_s: float, sent_s: float, now_s: float) -> None:
        """Lower the estimate below the rate at which the path served a late message.

        Args:
            sent_s: when it was sent. One of before the last decrease says nothing about the rate since.
        """
        if self._path_bytes_s is not None:
            return  # the path's own control knows better
        if sent_s >= self._lowered_s:
            self._ceiling = min(self._estimate, served_bytes_s)
        elif _DECREASE * served_bytes_s < self._estimate:
            self._ceiling = served_bytes_s
        else:
            return
        self._lowered_s, self._estimate = now_s, _DECREASE * self._ceiling
        self._choose(now_s)

    def _served_bytes_s(self, since_s: float, more_bytes: int, now_s: float) -> float:
        """Return the rate at which the path served a backlog: what left since then, and ``more_bytes``."""
        served = more_bytes + sum(size for left_s, size in self._left if left_s > since_s)
        return served / max(now_s - since_s, _LATE_S)

    def _wanted_bytes_s(self) -> float:
        """Return the bytes a second at the highest quality and rate."""
        return self._size_at(self._bounds.max_quality) * self._offered_hz()

    def _offered_hz(self) -> float:
        offered = 1 / self._gap_s if self._gap_s else self._bounds.max_hz or 30.0
        return offered if self._bounds.max_hz is None else min(offered, self._bounds.max_hz)

    def _size_at(self, quality: int) -> float:
        return self._size * (_size_of(quality) if self._bounds.has_quality else 1.0)

    def _choose(self, now_s: float) -> None:
        """Choose quality and rate for the estimate: the full rate at the best quality, else the lowest one slower."""
        bounds, budget = self._bounds, _USE * self.estimate_bytes_s
        top_hz = float("inf") if bounds.max_hz is None else bounds.max_hz
        if not self._size or budget == float("inf"):
            self._set_quality(bounds.max_quality, now_s)
            self.rate_hz = top_hz
            return
        offered_hz = self._offered_hz()
        if bounds.has_quality:
            fitting = _quality_of(budget / (offered_hz * self._size))
            self._set_quality(max(min(fitting, bounds.max_quality), bounds.min_quality), now_s)
        affordable_hz = budget / self._size_at(self.quality)
        self.rate_hz = top_hz if affordable_hz >= offered_hz else max(affordable_hz, bounds.min_hz)

    def _set_quality(self, quality: int, now_s: float) -> None:
        """Set the quality: a lower one at once, a higher one at ``_QUALITY_PER_S``."""
        if quality > self.quality:
            points = int(min((now_s - self._raised_s) * _QUALITY_PER_S, 1.0))
            if not points:
                return
            quality = self.quality + points
        self.quality, self._raised_s = quality, now_s

    def _shortest(self, waited_s: float, now_s: float) -> float:
        """Return the shortest wait of the last ``_BASE_S``."""
        waits = self._waits
        while waits and waits[-1][1] >= waited_s:
            waits.pop()
        waits.append((now_s, waited_s))
        while waits[0][0] < now_s - _BASE_S:
            waits.popleft()
        return waits[0][1]


def _size_of(quality: int) -> float:
    """Return the size of a JPEG of this quality, relative to one of 80."""
    for (low, small), (high, large) in pairwise(_SIZES):
        if quality <= high:
            return small + (large - small) * (quality - low) / (high - low)
    return _SIZES[-1][1]


def _quality_of(size: float) -> int:
    """Return the highest quality whose relative size is at most this; 1 for smaller ones."""
    for (low, small), (high, large) in pairwise(_SIZES):
        if size < large:
            return max(int(low + (high - low) * (size - small) / (large - small)), 1)
    return _SIZES[-1][0]
