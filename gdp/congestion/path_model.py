"""Model of a path: its round trips, standing queue, delivery rates and loss, as acknowledgements measure them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Sources: Copa (NSDI 2018) for the standing round trip; BBR
(draft-ietf-ccwg-bbr) for the rates. A queueing delay up to ``NOISE_S`` counts as none: programs on both ends are
scheduled, and read many frames at once.
"""

from __future__ import annotations

from collections import deque
from typing import Final

FIRST_RTT_S: Final = 0.02  # until one is measured
NOISE_S: Final = 0.002
_STANDING_REPORTS: Final = 4  # that all show a queue, where the empty path is shorter than that noise
_HOLD_WINDOW_S, _HOLD_MOST_S = 0.2, 0.01  # of reports; a reader reports at least each 20 ms while frames come
_LATE_KEPT: Final = 31 / 32  # from report to report
BASE_WINDOW_S: Final = 10.0  # Copa, section 2
_RATE_ROUNDS: Final = 10
_RECENT_ROUNDS: Final = 2
_CAPACITY_WINDOW_S: Final = 60.0  # longer than a competitor hides what the path can carry
_LOSS_FRAMES: Final = 1_000


class WindowedExtreme:
    """Highest sample of a window, or the lowest one; ``is_lowest``: which of both."""

    __slots__ = ("_sign", "_waiting")

    def __init__(self, *, is_lowest: bool) -> None:
        self._sign = 1.0 if is_lowest else -1.0
        self._waiting = deque[tuple[float, float]]()  # moment, signed value; ascending in both

    def add(self, at: float, value: float, oldest: float) -> float:
        """Add a sample, and forget those before ``oldest``; moments never decrease. Return the extreme."""
        signed, waiting = self._sign * value, self._waiting
        while waiting and waiting[-1][1] >= signed:
            waiting.pop()
        waiting.append((at, signed))
        while waiting[0][0] < oldest:
            waiting.popleft()
        return self._sign * waiting[0][1]

    def clear(self) -> None:
        """Forget all samples."""
        self._waiting.clear()


class PathModel:
    """What is known of one path.

    Attributes:
        rtt_s: smoothed round trip; None before the first one.
        base_rtt_s: round trip of the empty path.
        empty_path_s: longest round trip of a path whose queue is empty.
        standing_s: lowest round trip of the last half of one, and of four where programs take most of it.
        queue_s: standing queue, in seconds.
        highest_s: highest round trip of the last four; 0: none.
        hold_s: how long the reader holds back reports.
        late_s: how long reports wait here for this program, as it was in the last few dozen; 0: it reads at once.
        bytes_s: highest delivery rate of the last rounds; 0 before the first one.
        recent_bytes_s, peak_bytes_s, last_bytes_s: that of two rounds and of a minute, and the last one.
        capacity_bytes_s: highest rate of the last minute while more waited to be sent; None: nothing waited yet.
        is_hidden: another flow hides the empty path, so what is known of it stays.
        loss: share of frames that were lost lately, 0 to 1.
    """

    def __init__(self) -> None:
        self.loss = self.late_s = 0.0
        self.is_hidden = False
        self.reset()

    def reset(self) -> None:
        """Forget the path, except its loss."""
        self.rtt_s: float | None = None
        self._base = WindowedExtreme(is_lowest=True)
        self._standing = WindowedExtreme(is_lowest=True)
        self._trips = deque[float](maxlen=_STANDING_REPORTS)
        self._highest = WindowedExtreme(is_lowest=False)
        self._hold = WindowedExtreme(is_lowest=False)
        self.base_rtt_s = self.standing_s = FIRST_RTT_S
        self.empty_path_s = FIRST_RTT_S + NOISE_S
        self.queue_s = self.highest_s = self.hold_s = self.last_bytes_s = 0.0
        self.forget_rates()

    def forget_rates(self) -> None:
        """Forget the delivery rates: the path has become thin."""
        self._rates = WindowedExtreme(is_lowest=False)
        self._recent = WindowedExtreme(is_lowest=False)
        self._peaks = WindowedExtreme(is_lowest=False)
        self._capacities = WindowedExtreme(is_lowest=False)
        self.bytes_s = self.recent_bytes_s = self.peak_bytes_s = 0.0
        self.capacity_bytes_s: float | None = None

    def add_rtt(self, rtt_s: float, now_s: float) -> None:
        """Add a round trip."""
        self.rtt_s = rtt_s if self.rtt_s is None else self.rtt_s + (rtt_s - self.rtt_s) / 8
        self.base_rtt_s = self._base.add(now_s, rtt_s, float("-inf") if self.is_hidden else now_s - BASE_WINDOW_S)
        self.standing_s = self._standing.add(now_s, rtt_s, now_s - self.rtt_s / 2)
        self._trips.append(rtt_s)
        if self.base_rtt_s < NOISE_S:
            self.standing_s = min(self.standing_s, *self._trips)
        self.highest_s = self._highest.add(now_s, rtt_s, now_s - 4 * self.rtt_s)
        self.empty_path_s = self.base_rtt_s + NOISE_S
        self.queue_s = max(self.standing_s - self.empty_path_s, 0.0)

    def rest_at_standing(self, now_s: float) -> None:
        """Take the standing round trip for that of the empty path, which has changed."""
        self._base.clear()
        self.base_rtt_s = self._base.add(now_s, self.standing_s, now_s)
        self.empty_path_s = self.base_rtt_s + NOISE_S
        self.queue_s = 0.0

    def add_hold(self, hold_s: float, now_s: float) -> None:
        """Add how long the oldest frame of a report had waited for it."""
        hold_s = hold_s if hold_s < _HOLD_MOST_S else _HOLD_MOST_S
        self.hold_s = self._hold.add(now_s, hold_s, now_s - _HOLD_WINDOW_S)

    def add_wait(self, waited_s: float) -> None:
        """Add how long a report waited for this program."""
        self.late_s = max(waited_s, _LATE_KEPT * self.late_s)

    def add_rate(self, rate: float, at_round: int, now_s: float, *, is_full: bool) -> None:
        """Add a delivery rate; ``is_full``: the window was used, and more waited."""
        self.last_bytes_s = rate
        self.bytes_s = self._rates.add(at_round, rate, at_round - _RATE_ROUNDS)
        self.peak_bytes_s = self._peaks.add(now_s, rate, now_s - _CAPACITY_WINDOW_S)
        self.recent_bytes_s = self._recent.add(at_round, rate, at_round - _RECENT_ROUNDS)
        if is_full:
            self.capacity_bytes_s = self._capacities.add(now_s, rate, now_s - _CAPACITY_WINDOW_S) or None

    def add_loss(self, frames: int, lost: int) -> None:
        """Average the share of lost frames over about ``_LOSS_FRAMES``."""
        if lost or self.loss:
            part = min(frames / _LOSS_FRAMES, 1.0)
            self.loss += (lost / max(frames, 1) - self.loss) * part
