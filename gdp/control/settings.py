"""Node settings at start: marks of the new incarnation, randomness, and hello timing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gdp.control.hello import Timing
from gdp.intervals import ADVERTISEMENT, DETECT_MULTIPLIER, KEEPALIVE_MS, NEIGHBOUR


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSettings:
    """Start settings of a switch, a RIB or a participant.

    Args:
        incarnation: 64 random bits, new at each start.
        first_sequence: above every sequence number of an earlier incarnation; wall-clock milliseconds suffice.
        random_bytes: source of nonces.
        hello_s: between two hellos on a port.
        dead_s: a neighbour silent for this time is lost, while it sends no keepalives.
        lease_s: lease of what the node keeps at RIBs: advertisements of a participant or a RIB, watches of a switch.
        keepalive_ms: between keepalives, which neighbours negotiate; 0: none; None: in proportion to ``dead_s``.
        detect_multiplier: a neighbour silent for this number of keepalives is lost.
    """

    incarnation: int
    first_sequence: int
    random_bytes: Callable[[int], bytes]
    hello_s: float = NEIGHBOUR.refresh_s
    dead_s: float = NEIGHBOUR.lease_s
    lease_s: float = ADVERTISEMENT.lease_s
    keepalive_ms: int | None = None
    detect_multiplier: int = DETECT_MULTIPLIER

    @property
    def incarnation_id(self) -> bytes:
        """Return the mark of this incarnation, ``INCARNATION_BYTES``: of two, that of the older one is less."""
        return self.first_sequence.to_bytes(8, "big") + self.incarnation.to_bytes(8, "big")

    @property
    def timing(self) -> Timing:
        """Return the keepalive timing that this node requests."""
        every_ms = (
            round(KEEPALIVE_MS * self.dead_s / NEIGHBOUR.lease_s) if self.keepalive_ms is None else self.keepalive_ms
        )
        return Timing(every_ms, every_ms, self.detect_multiplier)
