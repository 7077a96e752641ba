"""Rates of a topic: messages and bytes in a window, as ``ros2 topic hz`` and ``ros2 topic bw`` state them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

_UNITS = ((1e6, "MB"), (1e3, "KB"))


class Arrivals:
    """Arrival times and sizes of the latest messages of a topic; ``window``: most messages that count, at least 2."""

    def __init__(self, window: int) -> None:
        self._latest = deque[tuple[float, int]](maxlen=window)
        self._is_new = False

    def add(self, now_s: float, size: int) -> None:
        """Count a message of this many bytes."""
        self._latest.append((now_s, size))
        self._is_new = True

    def poll_latest(self) -> list[tuple[float, int]]:
        """Return monotonic second and bytes of each; empty: none came since the last call, or fewer than two in all."""
        if not self._is_new or len(self._latest) < 2:
            return []
        self._is_new = False
        return list(self._latest)


class Frequency(NamedTuple):
    """Rate of messages, and the spread of the time between two of them; ``window``: messages in the window."""

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

    @classmethod
    def of(cls, latest: Sequence[tuple[float, int]], now_s: float) -> Frequency:
        """Return the rate of two messages or more."""
        del now_s
        gaps = [later - earlier for (earlier, _), (later, _) in pairwise(latest)]
        mean_s = sum(gaps) / len(gaps)
        variance = sum((gap - mean_s) ** 2 for gap in gaps) / len(gaps)
        rate_hz = 1 / mean_s if mean_s > 0 else math.inf
        return cls(rate_hz, min(gaps), max(gaps), math.sqrt(variance), len(latest))


class Bandwidth(NamedTuple):
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

    @classmethod
    def of(cls, latest: Sequence[tuple[float, int]], now_s: float) -> Bandwidth:
        """Return the rate since the first of two messages or more."""
        sizes = [size for _, size in latest]
        passed_s = max(now_s - latest[0][0], 1e-9)
        total = sum(sizes)
        return cls(total / passed_s, len(sizes), total / len(sizes), min(sizes), max(sizes))


def _size(count: float) -> str:
    unit, word = next(((unit, word) for unit, word in _UNITS if count >= unit), (1.0, "B"))
    return f"{count / unit:.2f} {word}" if unit > 1 else f"{count:.0f} {word}"
