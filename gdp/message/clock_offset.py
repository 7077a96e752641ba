"""Offset of another node's clock, from the stamps of messages to and from it, and the bound of its error.

Sans-I/O. Source: RFC 5905, sections 8 (four stamps) and 10 (of many samples those with the least delay count, and the
bound grows with their age). Stamps are of monotonic clocks, which never step; with them comes how far the wall clock is
ahead. So a step of either wall clock costs no sample, and is known with the next exchange.

A message that arrives was sent before: the one way gives a highest, the other a lowest offset. The truth lies between
the least of the former and the greatest of the latter, both aged.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError

DRIFT_MAX: Final = 100e-6  # between two clocks; RFC 5905, section 7.3, has 15 for a disciplined one
_DRIFT_ERROR_MAX: Final = DRIFT_MAX / 4  # of a measurement that is used
_STAMPS: Final = struct.Struct("!qqq")


class ClockStamps(NamedTuple):
    """Stamps of a reply, in microseconds.

    Args:
        received: when the request came, by a monotonic clock of the node that replies.
        sent: when the reply left.
        wall: what that node's wall clock shows more.
    """

    received: int
    sent: int
    wall: int

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _STAMPS.pack(*self)

    @classmethod
    def from_wire(cls, wire: bytes) -> ClockStamps:
        """Read the wire form. Raises ``FrameError``: the bytes are not exactly that."""
        if len(wire) != _STAMPS.size:
            raise FrameError(DropReason.MALFORMED, "stamps")
        return cls(*_STAMPS.unpack(wire))


class ClockEstimate(NamedTuple):
    """What a wall clock is ahead of ours, and how wrong that may be, in seconds."""

    offset_s: float
    bound_s: float

    @property
    def least_s(self) -> float:
        """Return by how much the clocks differ at least."""
        return max(abs(self.offset_s) - self.bound_s, 0.0)


class _Sample(NamedTuple):
    at_s: float
    offset_s: float
    bound_s: float


class ClockOffset:
    """Offset of one node's clock; ``drift``: how much faster that clock runs, as a share; 0 until it is measured."""

    __slots__ = ("_anchor", "_at_s", "_least_s", "_most_s", "_wall_s", "drift")

    def __init__(self) -> None:
        self.drift = 0.0
        self._at_s = self._least_s = self._most_s = self._wall_s = 0.0
        self._anchor: _Sample | None = None  # from which the drift is measured

    def add(self, sent_s: float, stamps: ClockStamps, came_s: float, now_s: float) -> None:
        """Add an exchange: a request that left and its reply that came, at monotonic seconds of ours."""
        aged_s = DRIFT_MAX * (now_s - sent_s)
        least_s, most_s = stamps.sent / 1e6 - came_s - aged_s, stamps.received / 1e6 - sent_s + aged_s
        if least_s > most_s:
            return  # no clock shows that
        self._least_s, self._most_s = self._aged(now_s)
        self._at_s = now_s
        if self._anchor is None or least_s > self._most_s or most_s < self._least_s:  # another clock: it started again
            self._anchor, self.drift, self._least_s, self._most_s = None, 0.0, least_s, most_s
        self._least_s, self._most_s = max(least_s, self._least_s), min(most_s, self._most_s)
        self._wall_s = stamps.wall / 1e6
        self._measure_drift(_Sample(now_s, (least_s + most_s) / 2, (most_s - least_s) / 2))

    def estimate(self, now_s: float, unix_s: float) -> ClockEstimate | None:
        """Return what that node's wall clock is ahead of ours; None: not known."""
        if self._anchor is None:
            return None
        least_s, most_s = self._aged(now_s)
        return ClockEstimate((least_s + most_s) / 2 + self._wall_s - (unix_s - now_s), (most_s - least_s) / 2)

    def _aged(self, now_s: float) -> tuple[float, float]:
        """Return the interval, moved by the drift, and so wide that it has the truth at any drift up to the most."""
        passed_s = max(now_s - self._at_s, 0.0)
        shift_s, growth_s = self.drift * passed_s, (DRIFT_MAX + abs(self.drift)) * passed_s
        return self._least_s + shift_s - growth_s, self._most_s + shift_s + growth_s

    def _measure_drift(self, sample: _Sample) -> None:
        """Measure the drift since the anchor, if that gives it well enough; the next one is measured from here."""
        anchor = self._anchor
        if anchor is None or sample.bound_s < anchor.bound_s / 2:
            self._anchor = sample
        elif anchor.bound_s + sample.bound_s < _DRIFT_ERROR_MAX * (sample.at_s - anchor.at_s):
            drift = (sample.offset_s - anchor.offset_s) / (sample.at_s - anchor.at_s)
            self._anchor, self.drift = sample, min(max(drift, -DRIFT_MAX), DRIFT_MAX)
