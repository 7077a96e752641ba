"""Delivery rate of a path, from what each acknowledgement confirms.

Sans-I/O. Source: draft-cheng-iccrg-delivery-rate-estimation-02. A sample is the bytes that arrived while a frame was
under way, divided by the longer of the times in which they were sent and confirmed. So neither a burst of frames nor an
aggregated acknowledgement appears as a high rate.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DeliveryRate", "Flight", "RateSample"]


@dataclass(slots=True, eq=False)
class Flight:
    """Frames of one stream that left at once, with the state of the path when they did; ``inflight`` includes them.

    ``place`` counts the frames of its stream up to its last one. ``is_repair``: all its frames were sent before.
    """

    size: int
    frames: int
    sent_s: float
    first_sent_s: float
    delivered: int
    delivered_s: float
    is_app_limited: bool
    inflight: int
    place: int = 0
    is_repair: bool = False
    is_under_way: bool = True


@dataclass(frozen=True, slots=True)
class RateSample:
    """Bytes a second over one flight; ``prior_delivered`` counts the rounds."""

    bytes_s: float
    prior_delivered: int
    is_app_limited: bool


class DeliveryRate:
    """Bytes of one path, sent and delivered.

    Attributes:
        delivered: bytes confirmed so far.
    """

    def __init__(self) -> None:
        self.delivered = 0
        self._delivered_s = 0.0
        self._first_sent_s = 0.0
        self._limited_until = 0

    def sent(self, size: int, now_s: float, inflight: int, frames: int = 1) -> Flight:
        """Return the flight of frames that leave; ``inflight``: bytes under way before it."""
        if not inflight:
            self._first_sent_s = self._delivered_s = now_s
        is_limited = self._limited_until > self.delivered
        return Flight(
            size, frames, now_s, self._first_sent_s, self.delivered, self._delivered_s, is_limited, inflight + size
        )

    def app_limited(self, inflight: int) -> None:
        """Mark what is under way, and what follows it: the program had nothing to send."""
        self._limited_until = self.delivered + max(inflight, 1)

    def acknowledged(self, newest: Flight, size: int, now_s: float, least_s: float) -> RateSample | None:
        """Return the sample of one acknowledgement; None if its interval is shorter than ``least_s``.

        Args:
            newest: of the frames that it confirms, the one that left last.
            size: bytes of all of them.
        """
        self.delivered += size
        self._delivered_s = now_s
        self._first_sent_s = newest.sent_s
        interval_s = max(newest.sent_s - newest.first_sent_s, now_s - newest.delivered_s)
        if interval_s <= 0 or interval_s < least_s:
            return None
        rate = (self.delivered - newest.delivered) / interval_s
        return RateSample(rate, newest.delivered, newest.is_app_limited)
