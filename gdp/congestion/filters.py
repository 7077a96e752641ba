"""Windowed extremes: the lowest or highest sample of the last seconds or rounds.

Sans-I/O. Each sample costs constant time on average (a monotonic queue).
"""

from __future__ import annotations

from collections import deque


class WindowedExtreme:
    """Highest sample of a window, or the lowest one.

    Args:
        is_lowest: which of both.
    """

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
