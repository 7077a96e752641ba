"""Rates of a topic: messages and bytes in a window, as ``ros2 topic hz`` and ``ros2 topic bw`` state them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import NamedTuple

__all__ = ["Bandwidth", "BandwidthReport", "Frequency", "FrequencyReport"]

_UNITS = ((1e6, "MB"), (1e3, "KB"))


class FrequencyReport(NamedTuple):
    """Rate of messages, and the spread of the time between two of them.

    Attributes:
        window: messages in the window.
    """

    rate_hz: float
    min_s: float
    max_s: float
    std_dev_s: float
    window: int

    def words(self) -> str:
        """Return the two lines of ``ros2 topic hz``."""
        return (
            f"average rate: {self.rate_hz:.3f}\n"
            f"\tmin: {self.min_s:.3f}s max: {self.max_s:.3f}s std dev: {self.std_dev_s:.5f}s window: {self.window}"
        )


class Frequency:
    """Arrival times of the latest messages.

    Args:
        window: most messages that count, at least 2.
    """

    def __init__(self, window: int) -> None:
        self._times_s = deque[float](maxlen=window)
        self._is_new = False

    def add(self, now_s: float) -> None:
        """Count a message."""
        self._times_s.append(now_s)
        self._is_new = True

    def poll_report(self) -> FrequencyReport | None:
        """Return the rate; None: no message since the last report, or fewer than two in all."""
        if not self._is_new or len(self._times_s) < 2:
            return None
        self._is_new = False
        times = list(self._times_s)
        gaps = [later - earlier for earlier, later in pairwise(times)]
        mean_s = sum(gaps) / len(gaps)
        variance = sum((gap - mean_s) ** 2 for gap in gaps) / len(gaps)
        rate_hz = 1 / mean_s if mean_s > 0 else math.inf
        return FrequencyReport(rate_hz, min(gaps), max(gaps), math.sqrt(variance), len(times))


class BandwidthReport(NamedTuple):
    """Bytes a second, and the sizes of messages in the window, in bytes of ROS's wire form."""

    bytes_s: float
    messages: int
    mean_bytes: float
    min_bytes: int
    max_bytes: int

    def words(self) -> str:
        """Return the two lines of ``ros2 topic bw``."""
        return (
            f"{_size(self.bytes_s)}/s from {self.messages} messages\n"
            f"\tMessage size mean: {_size(self.mean_bytes)} min: {_size(self.min_bytes)} max: {_size(self.max_bytes)}"
        )


class Bandwidth:
    """Arrival times and sizes of the latest messages.

    Args:
        window: most messages that count.
    """

    def __init__(self, window: int) -> None:
        self._arrivals = deque[tuple[float, int]](maxlen=window)
        self._is_new = False

    def add(self, now_s: float, size: int) -> None:
        """Count a message of this many bytes."""
        self._arrivals.append((now_s, size))
        self._is_new = True

    def poll_report(self, now_s: float) -> BandwidthReport | None:
        """Return the rate since the first message of the window; None: no message since the last report."""
        if not self._is_new or len(self._arrivals) < 2:
            return None
        self._is_new = False
        sizes = [size for _, size in self._arrivals]
        passed_s = max(now_s - self._arrivals[0][0], 1e-9)
        total = sum(sizes)
        return BandwidthReport(total / passed_s, len(sizes), total / len(sizes), min(sizes), max(sizes))


def _size(count: float) -> str:
    unit, word = next(((unit, word) for unit, word in _UNITS if count >= unit), (1.0, "B"))
    return f"{count / unit:.2f} {word}" if unit > 1 else f"{count:.0f} {word}"
