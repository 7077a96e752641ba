"""Damping of flapping links: a link that flaps is a last resort until it has been stable.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: the penalty with a half-life of RFC 2439, section 2.3.
Paths follow a lost link at once, and use a link again at once that comes back once or twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from gdp.names import Name

HALF_LIFE_S: Final = 5.0
SUPPRESS_ABOVE: Final = 3.5  # losses of the link; older ones count less
REUSE_BELOW: Final = 1.5
PENALTY_MAX: Final = 6.0  # so that no link waits longer than ten seconds
_LINKS_MAX: Final = 1_024

Link = tuple[int, Name]  # port, neighbour


@dataclass(slots=True)
class _Penalty:
    value: float
    at_s: float
    is_suppressed: bool = False

    def now(self, now_s: float) -> float:
        return self.value * math.pow(2.0, (self.at_s - now_s) / HALF_LIFE_S)

    def reused_at_s(self) -> float:
        return self.at_s + HALF_LIFE_S * math.log2(self.value / REUSE_BELOW)


class Damping:
    """Links of this switch that flapped too often recently."""

    def __init__(self) -> None:
        self._penalties: dict[Link, _Penalty] = {}

    def went(self, link: Link, now_s: float) -> None:
        """Record that a link was lost."""
        known = self._penalties.pop(link, None)
        value = min((0.0 if known is None else known.now(now_s)) + 1.0, PENALTY_MAX)
        is_suppressed = value > SUPPRESS_ABOVE or (known is not None and known.is_suppressed)
        self._penalties[link] = _Penalty(value, now_s, is_suppressed)
        if len(self._penalties) > _LINKS_MAX:
            del self._penalties[next(iter(self._penalties))]

    def suppresses(self, link: Link) -> bool:
        """Return whether a link is a last resort."""
        known = self._penalties.get(link)
        return known is not None and known.is_suppressed

    def expire(self, now_s: float) -> None:
        """Release links whose penalty has decayed, whether they are up or down."""
        for each in self._penalties.values():
            if each.is_suppressed and now_s >= each.reused_at_s():
                each.is_suppressed = False

    def next_reuse(self) -> float | None:
        """Return the monotonic second at which the next link may be used again, or None."""
        return min((each.reused_at_s() for each in self._penalties.values() if each.is_suppressed), default=None)
