"""Flow control of a reliable writer: bytes under way, round-trip time, and the timer that probes silent readers.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: round-trip estimate after RFC 6298, section 2, with
Karn's rule. Positions count bytes of frames from the first message on.
"""

from __future__ import annotations

from typing import Final

from gdp.limits import FLIGHT_MAX_BYTES
from gdp.requests import Backoff

PROBES: Final = Backoff(0.03, 0.25)  # of readers from which nothing comes


class RoundTripEstimator:
    """Smoothed round-trip time of frames that were sent once.

    Attributes:
        rtt_s: smoothed estimate; None before the first sample.
        deviation_s: smoothed mean deviation.
        sample: a position and when it was sent, until it is acknowledged; None: none is running.
    """

    def __init__(self) -> None:
        self.rtt_s: float | None = None
        self.deviation_s = 0.0
        self.sample: tuple[int, float] | None = None

    def handle_sent(self, sent_at: int, now_s: float) -> None:
        """Start a sample at a position that was just sent, unless one is running."""
        if self.sample is None:
            self.sample = sent_at, now_s

    def handle_acknowledged(self, acked_at: int, now_s: float) -> None:
        """Finish the sample if its position is acknowledged."""
        if self.sample is not None and acked_at >= self.sample[0]:
            self.add(now_s - self.sample[1])
            self.discard_sample()

    def discard_sample(self) -> None:
        """Discard the running sample: the acknowledgement of a retransmitted frame is ambiguous (Karn's rule)."""
        self.sample = None

    def add(self, sample_s: float) -> None:
        """Add a sample, in seconds."""
        if self.rtt_s is None:
            self.rtt_s, self.deviation_s = sample_s, sample_s / 2
            return
        self.deviation_s += (abs(sample_s - self.rtt_s) - self.deviation_s) / 4
        self.rtt_s += (sample_s - self.rtt_s) / 8


class FlowControl:
    """Bound of the bytes under way, and the probe timer of silent readers.

    How much the path carries is another question, which the congestion controllers answer (``gdp/congestion``).

    Attributes:
        window_bytes: what a reader must be able to hold.
        round_trip: estimate of the round-trip time.
        probe_at_s: monotonic second at which readers are probed, if something is under way.
    """

    window_bytes: Final = FLIGHT_MAX_BYTES

    def __init__(self) -> None:
        self.round_trip = RoundTripEstimator()
        self._probe_s = self.probe_at_s = PROBES.first_s  # after a time without an acknowledgement

    def handle_acknowledged(self, new_bytes: int, acked_at: int, now_s: float) -> None:
        """Process an acknowledgement of ``new_bytes`` up to ``acked_at``, and restart the probe timer."""
        if new_bytes <= 0:
            return
        trip = self.round_trip
        trip.handle_acknowledged(acked_at, now_s)
        self._probe_s = PROBES.pause_s(1, 3 * (trip.rtt_s or 0.0) + 4 * trip.deviation_s)
        self.probe_at_s = now_s + self._probe_s

    def restart_probe(self, now_s: float) -> None:
        """Restart the probe timer: nothing is under way."""
        self.probe_at_s = now_s + self._probe_s

    def probe_due(self, now_s: float) -> bool:
        """Return whether readers have been silent for too long; if so, the next interval doubles."""
        if now_s < self.probe_at_s:
            return False
        self._probe_s = PROBES.after_s(self._probe_s)
        self.probe_at_s = now_s + self._probe_s
        return True
