"""Pools that reach a target, under each assumption about joint failures.

Sans-I/O. The result has several numbers because the data do not decide between the assumptions: machines fail
independently, or machines of one region fail together as often as the worst pair in the recorded traces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fog.plan.failure import joint, joint_in_one_region, more_in_one_region
from fog.plan.mix import Kind, Mix, cheapest_mix

PAPER_UPTIME_S: Final = 15 * 3600.0  # the worked example of FogROS2-FT
PAPER_RECOVERY_S: Final = 20 * 60.0
ON_DEMAND_DOWN: Final = 0.005  # AWS's service level agreement promises 99.5 % a month for a single EC2 machine


@dataclass(frozen=True, slots=True)
class Standing:
    """Machines that run already: the chance of each that it is down."""

    spot: tuple[float, ...] = ()
    on_demand: tuple[float, ...] = ()


NONE: Final = Standing()


@dataclass(frozen=True, slots=True)
class Pool:
    """Machines to add, and the resulting figures.

    Args:
        mix: machines to add if failures are independent, as assumed for different regions.
        replicas: total, including those that run already.
        chance: that all are down at once.
        chance_in_one_region: the same, if all spot machines of the pool were in one region.
        replicas_in_one_region: number that the target needs there; None: no number of spot machines reaches it.
    """

    mix: Mix
    replicas: int
    chance: float
    chance_in_one_region: float
    replicas_in_one_region: int | None


def pool_for(target: float, spot: Kind, on_demand: Kind | None, factor: float, standing: Standing = NONE) -> Pool:
    """Return the cheapest pool of spot machines, or a mixed pool if ``on_demand`` is given.

    Args:
        target: largest chance that all are down at once, in (0, 1).
        factor: ratio of joint failures of two spot machines in one region to independent failures.

    Raises:
        LocalError: a chance or the target lies outside (0, 1), or ``factor`` is less than 1.
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
