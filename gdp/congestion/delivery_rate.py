"""Flights of a path, and its delivery rate, from what each acknowledgement confirms.

Sans-I/O. Source: draft-cheng-iccrg-delivery-rate-estimation-02. A sample is the bytes that arrived while a frame was
under way, divided by the longer of the times in which they were sent and confirmed. So neither a burst of frames nor an
aggregated acknowledgement appears as a high rate.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import takewhile


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


class DeliveryRate:
    """Bytes of one path: sent, under way, and delivered.

    Attributes:
        delivered: bytes confirmed so far.
        inflight: bytes under way.
        limited_until: bytes confirmed up to which what leaves was all that the program had to send.
    """

    def __init__(self) -> None:
        self.delivered = 0
        self.inflight = 0
        self._flights: dict[Flight, None] = {}  # in the order in which they left
        self._delivered_s = 0.0
        self._first_sent_s = 0.0
        self.limited_until = 0

    def sent(self, size: int, now_s: float, frames: int = 1) -> Flight:
        """Return the flight of frames that leave."""
        if not self.inflight:
            self._first_sent_s = self._delivered_s = now_s
        self.inflight += size
        is_limited = self.limited_until > self.delivered
        flight = Flight(
            size, frames, now_s, self._first_sent_s, self.delivered, self._delivered_s, is_limited, self.inflight
        )
        self._flights[flight] = None
        return flight

    def remove(self, flight: Flight) -> bool:
        """Take a flight off the account; return whether it was on it."""
        was_under_way, flight.is_under_way = flight.is_under_way, False
        if was_under_way:
            del self._flights[flight]
            self.inflight -= flight.size
        return was_under_way

    def forget(self, flights: Iterable[Flight]) -> None:
        """Take flights off the account whose fate will not be known."""
        for flight in flights:
            self.remove(flight)

    def forget_before(self, sent_s: float = float("inf")) -> None:
        """Take flights off the account that left before ``sent_s``, or all."""
        self.forget(list(takewhile(lambda flight: flight.sent_s < sent_s, self._flights)))

    def acknowledged(self, newest: Flight, size: int, at_s: float, least_s: float) -> float | None:
        """Return the bytes a second of one acknowledgement; None if its interval is shorter than ``least_s``.

        Args:
            newest: of the frames that it confirms, the one that left last.
            size: bytes of all of them.
            at_s: when it would have come if the reader had not held it back.
        """
        self.delivered += size
        self._delivered_s = at_s if at_s > self._delivered_s else self._delivered_s
        self._first_sent_s = newest.sent_s
        sending_s, interval_s = newest.sent_s - newest.first_sent_s, self._delivered_s - newest.delivered_s
        interval_s = sending_s if sending_s > interval_s else interval_s
        if interval_s <= 0 or interval_s < least_s:
            return None
        return (self.delivered - newest.delivered) / interval_s
