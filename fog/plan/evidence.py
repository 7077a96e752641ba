"""Measurements of spot machines in recorded traces: uptime and joint failures.

Sans-I/O.

The share of time in which *both* zones lack machines is not informative when this is the normal state of each zone: the
ratio to independence cannot exceed one over the larger share. The factor is therefore measured on the rarer state, here
"a machine is available": 1.6 to 3.7 for the pairs of one region. An alternative measure are outages of a given length
after each preemption. They coincide 0.8 to 3.5 times as often as independent ones, but they are few.
``fog.catalog`` ships all these figures.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pair:
    """Two zones of one region; ratios are relative to independence.

    Args:
        free_together: machines available in both; the rarer state.
        taken_together: machines available in neither.
        outages_together: seconds after a preemption within which both have one -> ratio.
    """

    zones: tuple[str, str]
    free_together: float
    taken_together: float
    outages_together: dict[int, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Measurements of all zones.

    Args:
        uptime_s: mean time until a machine was preempted, over all zones.
        back_s: mean time until the same zone had a machine again, over all zones.
        taken_share: zone -> share of time without an available machine.
        all_free_together: as ``Pair.free_together``, for all zones at once.
    """

    source: str
    uptime_s: float
    back_s: float
    taken_share: dict[str, float]
    pairs: tuple[Pair, ...]
    all_free_together: float

    @property
    def factors(self) -> tuple[float, float]:
        """Return the smallest and the largest ratio of a pair of one region, on the rarer state."""
        each = [pair.free_together for pair in self.pairs]
        return min(each), max(each)
