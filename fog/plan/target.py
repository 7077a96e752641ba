"""Machines for a target availability, from the machines that a launch file lists.

Sans-I/O. Source: FogROS2-FT, the section on spot machines; ``failure`` has the formula, and ``correlation`` its
extension for machines that share a region.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from fog.cluster import MachineRequest
from fog.hardware import Offer
from fog.plan.answer import assumptions
from fog.plan.choice import Choice, choose
from fog.plan.evidence import Measured
from fog.plan.failure import chance_down, joint, joint_over_regions
from fog.plan.pool import ON_DEMAND_DOWN, PAPER_RECOVERY_S, PAPER_UPTIME_S
from gdp.errors import LocalError

MACHINES_MAX: Final = 64
_ROUNDING: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Target:
    """Machines that reach an availability.

    Args:
        availability: share of time, in (0, 1), for which at least one machine is to serve.
        p_vm: share of time for which a spot machine is down.
        p_system: share of time for which all are down.
    """

    availability: float
    machines: tuple[MachineRequest, ...]
    p_vm: float
    p_system: float
    assumptions: tuple[str, ...]


def machines_for(
    availability: float,
    listed: Sequence[MachineRequest],
    offers: Sequence[Offer],
    seen: Measured,
    latency_ms: Mapping[str, float] | None = None,
) -> Target:
    """Return the listed machines, and as many copies in other regions as the target needs.

    Raises:
        LocalError: the target lies outside (0, 1), no offer fits a listed machine, or no number of machines reaches
            the target.
    """
    if not 0 < availability < 1:
        raise LocalError(f"availability={availability:g}: expected a share of time between 0 and 1, such as 0.9995")
    down = chance_down(PAPER_UPTIME_S, PAPER_RECOVERY_S)
    factor = seen.factors[1]
    allowed = 1 - availability
    machines = list(listed)
    chance = _chance(choose(offers, machines, latency_ms), down, factor)
    while chance > allowed * (1 + _ROUNDING):
        machines.append(replace(listed[(len(machines) - len(listed)) % len(listed)], region=""))
        before, chance = chance, _chance(choose(offers, machines, latency_ms), down, factor)
        if chance >= before or len(machines) > MACHINES_MAX:
            raise LocalError(
                f"availability={availability:g} is out of reach: the best that the regions there are allow is"
                f" {1 - before:.6g}, with {len(machines) - 1}; list a CloudMachine, or ask for less"
            )
    kinds = sorted({"spot" if each.is_spot else "on-demand" for each in machines})
    return Target(availability, tuple(machines), down, chance, tuple(assumptions(kinds, seen)))


def _chance(choices: Sequence[Choice], down: float, factor: float) -> float:
    """Return the chance that all are down; only spot machines of one region are correlated."""
    regions: dict[str, list[float]] = {}
    steady = []
    for choice in choices:
        if choice.offer.is_spot:
            regions.setdefault(choice.offer.region, []).append(down)
        else:
            steady.append(ON_DEMAND_DOWN)
    return joint(steady) * joint_over_regions(regions, factor)
