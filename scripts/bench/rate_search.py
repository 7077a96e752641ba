"""Search for the highest rate that holds, one rate at a time.

Sans-I/O. A try holds under three conditions. It loses less than ``LOSS_MAX`` of its frames. The last frame arrives soon
after the last sending, because a rate that only fills queues does not count. The source kept the rate. Where frames are
forwarded in the sender's own time, the best of three tries at full speed shows the rate. Else the rate is bracketed and
bisected. A rate that fails is tried once more, because other load of the machine can spoil a single try.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

LOSS_MAX: Final = 0.001
LATE_MAX_S: Final = 0.05
_CLOSE: Final = 1.05  # bracket narrow enough
_STEP: Final = 1.25
_FLAT_TRIES: Final = 3
_TRIES_MAX: Final = 14


@dataclass(frozen=True, slots=True)
class Try:
    """Result of sending for a while.

    Attributes:
        asked: frames/s requested; None for full speed.
        sent: frames that left the source.
        got: frames that the sink counted.
        sink_drops: frames that reached the sink and found its buffer full; lost like the others.
        send_s: from the first sending to the last.
        late_s: from the last sending to the last arrival.
        cpu_s: processor time of the source, of the kernel's soft interrupt threads and of the switches.
    """

    asked: float | None
    sent: int
    got: int
    sink_drops: int
    send_s: float
    late_s: float
    cpu_s: float

    @property
    def loss(self) -> float:
        """Return the share of frames that did not come."""
        return 1 - self.got / self.sent if self.sent else 1.0

    @property
    def rate(self) -> float:
        """Return frames/s from the first sending to the last arrival."""
        return self.got / (self.send_s + max(0.0, self.late_s))

    @property
    def holds(self) -> bool:
        """Return whether the path carries this rate."""
        kept = self.asked is None or self.sent >= 0.95 * self.asked * self.send_s
        return kept and self.loss < LOSS_MAX and self.late_s < LATE_MAX_S


def highest(attempt: Callable[[float | None], Try], guess: float | None) -> Try | None:
    """Return the try with the highest rate that held; None if none did.

    ``attempt``: sends at a rate (None: full speed). ``guess``: an approximate rate, where one is known; else the search
    begins at full speed.
    """
    low: Try | None = None
    high = float("inf")
    if guess is None:
        flat = max((attempt(None) for _ in range(_FLAT_TRIES)), key=lambda tried: (tried.holds, tried.rate))
        if flat.holds:
            return flat
        high, guess = flat.sent / flat.send_s, 0.95 * flat.rate
    rate = guess
    step = 1.0
    for _ in range(_TRIES_MAX):
        tried = attempt(rate)
        if not tried.holds:
            tried = attempt(rate)
        if tried.holds:
            low = tried
        else:
            high = rate
        minimum = low.asked if low and low.asked else 0.0
        if high <= minimum * _CLOSE:
            break
        step *= _STEP  # growing strides, because the guess may be far off
        rate = _next(minimum, high, step)
    return low


def _next(minimum: float, high: float, step: float) -> float:
    """Return the next rate to try: outside an open bracket, else in its middle."""
    if not minimum:
        return high / step
    return minimum * step if high == float("inf") else (minimum + high) / 2
