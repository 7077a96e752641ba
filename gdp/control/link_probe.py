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

from gdp.control.link_quality import LinkQuality
from gdp.intervals import SCHEDULED_S

POLLS_MIN: Final = 3  # two may be lost
_LEAST_S: Final = 0.05
_UNMEASURED_S: Final = 0.2
_VARIATIONS: Final = 4  # RFC 6298, section 2
_PER_LOSS: Final = 20.0  # twice the time where a twentieth of the frames is lost


@dataclass(slots=True, kw_only=True)
class LinkProbe:
    """A probe of one neighbour.

    Attributes:
        since_s: when it began.
        is_moved: this node's address has changed; otherwise the neighbour is silent.
        polls: number of polls that were sent.
        worked_s: since when it is known that other links answer; None: it is not known.
    """

    since_s: float
    is_moved: bool = False
    polls: int = 0
    worked_s: float | None = None

    def is_answered(self, confirmed_s: float) -> bool:
        """Return whether a keepalive of the probed neighbour ends the probe.

        Args:
            confirmed_s: when the last of our keepalives that the neighbour has echoed was sent. After a change of the
                address, keepalives to the former one may still arrive, and show nothing.
        """
        return not self.is_moved or self._covers(confirmed_s)

    def note_other(self, confirmed_s: float) -> None:
        """Note that another link has answered a keepalive that was sent then; the first one after the begin counts."""
        if self.worked_s is None and self._covers(confirmed_s):
            self.worked_s = confirmed_s

    def _covers(self, sent_s: float) -> bool:
        """Return whether a keepalive of ours was sent in this probe, of a moved node not from its former address."""
        return sent_s > self.since_s or (sent_s == self.since_s and not self.is_moved)

    def fails_at_s(self, quality: LinkQuality) -> float:
        """Return when the neighbour is lost; never unless another link works, and not before ``POLLS_MIN`` polls."""
        if self.worked_s is None or self.polls < POLLS_MIN:
            return float("inf")
        return self.worked_s + patience_s(quality)


def patience_s(quality: LinkQuality) -> float:
    """Return how long an answer to polls may take over a link, in seconds; more polls fit in where frames are lost."""
    rtt = quality.rtt
    if rtt.srtt_s is None:
        return _UNMEASURED_S
    answer_s = max(_LEAST_S, rtt.srtt_s + _VARIATIONS * rtt.rttvar_s + SCHEDULED_S)
    return answer_s * (1 + _PER_LOSS * max(quality.loss_in, quality.loss_out))
