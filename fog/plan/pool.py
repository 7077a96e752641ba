"""A pool that reaches a target, under each assumption that can be made about failing together.

Sans-I/O. It answers with several numbers, because the data decide between them for nobody: machines that fail
independently, and machines of one region that fail together as often as the worst pair in the recorded traces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fog.plan.correlation import joint_in_one_region, more_in_one_region
from fog.plan.failure import joint
from fog.plan.mix import Kind, Mix, cheapest_mix

__all__ = ["ON_DEMAND_DOWN", "PAPER_RECOVERY_S", "PAPER_UPTIME_S", "Pool", "Standing", "pool_for"]

PAPER_UPTIME_S: Final = 15 * 3600.0  # the worked example of FogROS2-FT
PAPER_RECOVERY_S: Final = 20 * 60.0
ON_DEMAND_DOWN: Final = 0.005  # AWS's service level agreement promises 99.5 % a month for a single EC2 machine


@dataclass(frozen=True, slots=True)
class Standing:
    """Machines that run already: the chances that each is down."""

    spot: tuple[float, ...] = ()
    on_demand: tuple[float, ...] = ()


NONE: Final = Standing()


@dataclass(frozen=True, slots=True)
class Pool:
    """What to add, and what comes of it.

    Args:
        mix: what to add, if machines are independent, as they are assumed to be in different regions.
        replicas: with those that stand already.
        chance: that all are down at once.
        chance_in_one_region: the same pool's, if all its spot machines stood in one region.
        replicas_in_one_region: how many the target takes there; None: no number of spot machines reaches it.
    """

    mix: Mix
    replicas: int
    chance: float
    chance_in_one_region: float
    replicas_in_one_region: int | None


def pool_for(target: float, spot: Kind, on_demand: Kind | None, factor: float, standing: Standing = NONE) -> Pool:
    """Return the cheapest pool of spot machines, or of these and others where a kind of others is given.

    Args:
        target: largest chance that all are down at once, in (0, 1).
        factor: how many times as often as independent ones two spot machines of one region are down together.

    Raises:
        LocalError: a chance or the target lies outside (0, 1), ``factor`` is less than 1.
    """
    kinds: Sequence[Kind] = (spot,) if on_demand is None else (spot, on_demand)
    have = (*standing.spot, *standing.on_demand)
    mix = cheapest_mix(kinds, target, have)
    steady = joint(standing.on_demand) * (on_demand.chance ** mix.more[1] if on_demand else 1.0)
    all_spot = (*standing.spot, *[spot.chance] * mix.more[0])
    left = target / joint(standing.on_demand)
    more = 0 if left >= 1 else more_in_one_region(spot.chance, left, factor, standing.spot)
    return Pool(
        mix,
        len(have) + sum(mix.more),
        mix.chance,
        joint_in_one_region(all_spot, factor) * steady,
        None if more is None else len(have) + more,
    )
