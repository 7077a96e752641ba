"""Replay window: a sliding window of the message numbers that are finished.

Sans-I/O. Source: the anti-replay window of RFC 4303, section 3.4.3, with messages for packets.
"""

from __future__ import annotations

from collections.abc import Iterator

from gdp.limits import REPLAY_WINDOW_MESSAGES


class ReplayWindow:
    """The last ``size`` message numbers of one incarnation; older ones count as finished.

    Attributes:
        top: the highest finished number; -1 when there is none.
    """

    __slots__ = ("_bits", "_mask", "_size", "top")

    def __init__(self, size: int = REPLAY_WINDOW_MESSAGES) -> None:
        self._size = size
        self._mask = (1 << size) - 1
        self.top = -1
        self._bits = 0  # bit i: number top - i is finished

    def is_finished(self, number: int) -> bool:
        """Return whether a message was finished, or is older than the window."""
        behind = self.top - number
        return behind >= 0 and (behind >= self._size or bool(self._bits >> behind & 1))

    def finish(self, number: int) -> None:
        """Mark a message as finished: opened, or given up for good."""
        ahead = number - self.top
        if ahead > 0:
            self._bits = (self._bits << ahead | 1) & self._mask if ahead < self._size else 1
            self.top = number
        elif -ahead < self._size:
            self._bits |= 1 << -ahead

    def unfinished(self, begin: int, end: int) -> Iterator[int]:
        """Yield, rising, the numbers from ``begin`` up to, not including, ``end`` that are not finished.

        Each costs the same, however many finished ones lie between and however far apart the two bounds are.
        """
        begin = max(begin, self.top - self._size + 1)
        behind = self.top - begin
        if behind >= 0:
            holes = ~self._bits & (2 << behind) - 1
            while holes:
                at = holes.bit_length() - 1
                if self.top - at >= end:
                    return
                yield self.top - at
                holes ^= 1 << at
        yield from range(max(begin, self.top + 1), end)
