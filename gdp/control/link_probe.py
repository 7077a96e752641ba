"""Probe of a link: whether a neighbour that does not answer is lost before the detection time of its keepalives ends.

Sans-I/O; time comes in as monotonic seconds. Source: poll and final of RFC 5880, section 6.5. A neighbour is probed
when it is silent, or when this node's address on an uplink has changed. It is polled often, and is lost early only if
another link answers polls meanwhile::

    reason of the probe   link that must answer                     what follows
    silence               to the same neighbour                     its node is alive, so this link has failed, and
                                                                    silent ones over the same uplink have, too
    changed address       to the same neighbour, or of this uplink  the uplink works, but not towards this neighbour

So a node that is slow, and an uplink that is not usable yet, have the whole detection time. A link has answered if a
keepalive echoes a count that was sent after the probe began.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.control.link_quality import RttEstimator

__all__ = ["LinkProbe", "patience_s"]

POLLS_MIN: Final = 2  # one may be lost
_LEAST_S: Final = 0.05
_MARGIN_S: Final = 0.02  # for the work of the far end
_UNMEASURED_S: Final = 0.2
_VARIATIONS: Final = 4  # RFC 6298, section 2


@dataclass(slots=True, kw_only=True)
class LinkProbe:
    """A probe of one neighbour.

    Attributes:
        since_s: when it began.
        is_moved: this node's address has changed; otherwise the neighbour is silent.
        polls: number of polls that were sent.
    """

    since_s: float
    is_moved: bool = False
    polls: int = 0

    def is_answered(self, confirmed_s: float) -> bool:
        """Return whether a keepalive of the probed neighbour ends the probe.

        Args:
            confirmed_s: when the last of our keepalives that the neighbour has echoed was sent. After a change of the
                address, keepalives to the former one may still arrive, and show nothing.
        """
        return not self.is_moved or confirmed_s >= self.since_s

    def fails_at_s(self, rtt: RttEstimator) -> float:
        """Return when the neighbour is lost if another link has answered; never before ``POLLS_MIN`` polls."""
        return self.since_s + patience_s(rtt) if self.polls >= POLLS_MIN else float("inf")


def patience_s(rtt: RttEstimator) -> float:
    """Return how long an answer to polls may take, in seconds."""
    if rtt.srtt_s is None:
        return _UNMEASURED_S
    return max(_LEAST_S, rtt.srtt_s + _VARIATIONS * rtt.rttvar_s + _MARGIN_S)
