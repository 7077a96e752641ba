"""What was measured of spot machines in recorded traces: how long they stay, and how they fail together.

Sans-I/O.

Which share of time two zones are *both* without machines says little when that is the normal state of each: no ratio to
independence can exceed one over the larger share. The factor is therefore taken over the rarer state, here "a machine
is to be had": 1.6 to 3.7 for the pairs of one region. Outages of a given length after each preemption, the other way to
ask, coincide 0.8 to 3.5 times as often; they are few. ``fog.catalog`` ships all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Measured", "Pair"]


@dataclass(frozen=True, slots=True)
class Pair:
    """Two zones of one region; ratios are to what independence says.

    Args:
        free_together: machines to be had in both; the rarer state.
        taken_together: in neither.
        outages_together: both within so many seconds of a preemption -> ratio.
    """

    zones: tuple[str, str]
    free_together: float
    taken_together: float
    outages_together: dict[int, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """The measurements.

    Args:
        source: of the traces, with machine type, region and length.
        uptime_s: mean time until a machine was taken, over all zones.
        back_s: mean time until the same zone had one again, over all zones.
        taken_share: by zone, the share of time without a machine to be had.
        all_free_together: as ``Pair.free_together``, of all zones at once.
    """

    source: str
    uptime_s: float
    back_s: float
    taken_share: dict[str, float]
    pairs: tuple[Pair, ...]
    all_free_together: float

    @property
    def factors(self) -> tuple[float, float]:
        """The smallest and the largest ratio of a pair of one region, over the rarer state."""
        each = [pair.free_together for pair in self.pairs]
        return min(each), max(each)
