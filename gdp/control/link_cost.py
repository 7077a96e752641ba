"""Cost of a link from its measured round-trip time and loss, and its damping.

Sans-I/O; time comes in as monotonic seconds.

::

    cost = (10 + rtt in milliseconds) * ETX ** 3      ETX = 1 / ((1 - loss out) * (1 - loss in))

Sources: RFC 9616, section 3.3 (cost from the round-trip time); RFC 8966, appendix A.2.2 (ETX). Three points differ. The
time has no upper bound, so the sum over a path follows its delay, with 10 for each hop. Loss counts by the cube of ETX:
a lost frame costs three passages, the frame, the request and the repair. All traffic of a link has one cost.

Damping keeps routes from oscillating (RFC 9616, section 3.4, hysteresis). The advertised cost changes only when the
measured one has been outside a band around it for some time: 3 s if it is worse, 15 s if it is better. Between two
changes at least 5 s pass.
"""

from __future__ import annotations

from typing import Final

from gdp.limits import COST_DEFAULT

COST_MAX: Final = 1_000_000
COST_UNMEASURED: Final = 100  # that of a link of 90 ms: until it is measured, no path leaves a known one for it
BAND: Final = 1.25
BAND_MIN: Final = 5.0  # in units of cost: noise of a local cable
WORSE_S: Final = 3.0
BETTER_S: Final = 15.0
INTERVAL_S: Final = 5.0
_LOSS_MAX: Final = 0.99
_PASSAGES: Final = 3


def link_cost(rtt_s: float, loss_in: float, loss_out: float) -> int:
    """Return the cost of a link, 10 to ``COST_MAX``; it rises with each argument.

    Args:
        rtt_s: smoothed round-trip time, seconds.
        loss_in: share of frames lost on the way here, 0 to 1.
        loss_out: share of frames lost on the way to the neighbour, 0 to 1.
    """
    arrives = (1 - min(loss_in, _LOSS_MAX)) * (1 - min(loss_out, _LOSS_MAX))
    return min(round((COST_DEFAULT + 1_000 * rtt_s) / arrives**_PASSAGES), COST_MAX)


class DampedCost:
    """The cost of a link that is advertised.

    Attributes:
        advertised: ``COST_UNMEASURED`` before the first measurement, which counts at once.
        measured: the last measurement; None before the first.
    """

    __slots__ = ("_changed_s", "_is_worse", "_since_s", "advertised", "measured")

    def __init__(self) -> None:
        self.advertised = COST_UNMEASURED
        self.measured: int | None = None
        self._changed_s = 0.0
        self._is_worse = False  # the side of the band that the measured cost is on since ``_since_s``
        self._since_s: float | None = None

    def update(self, measured: int, now_s: float) -> bool:
        """Note a measured cost; return whether the advertised one changed."""
        is_first, self.measured = self.measured is None, measured
        if is_first:
            return self._advertise(measured, now_s)
        low, high = sorted((measured, self.advertised))
        if high <= low * BAND or high - low < BAND_MIN:
            self._since_s = None
            return False
        is_worse = measured > self.advertised
        if self._since_s is None or is_worse is not self._is_worse:
            self._since_s, self._is_worse = now_s, is_worse
        is_lasting = now_s - self._since_s >= (WORSE_S if is_worse else BETTER_S)
        if not is_lasting or now_s - self._changed_s < INTERVAL_S:
            return False
        return self._advertise(measured, now_s)

    def _advertise(self, cost: int, now_s: float) -> bool:
        is_new = cost != self.advertised
        self.advertised, self._changed_s, self._since_s = cost, now_s, None
        return is_new
