"""Replica count for a target availability if machines fail independently, and joint failure if they do not.

Sans-I/O; numbers in, numbers out.
Source: FogROS2-FT, the section on spot machines. P_VM = recovery / (uptime + recovery), P_system = product of all P_i,
N = ceil(log P_system / log P_VM). The paper prints the ratio of logarithms inverted; this form follows from its own
product formula and gives its worked figure (15 h up, 20 min to recover: two spot machines are under 0.05 %).
Model of failures that are correlated within a region: its first machine is down with its own chance. Each further
machine is down ``factor`` times as often as alone while the machines before it are down:
P = p1 * min(1, factor * p2) * min(1, factor * p3) * ... Chances of different regions multiply. With the largest factor
of a pair, the model exceeds the measurement for three machines in the same traces (13.6 times independence against 7.0;
``fog.plan.evidence``). The model does not cover joint failures of regions: there are no data for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from gdp.errors import LocalError

_ROUNDING: Final = 1e-9  # 0.1 ** 3 exceeds 0.001 by rounding, but three replicas are enough


def chance_down(uptime_s: float, recovery_s: float) -> float:
    """Return the share of time for which one machine is not serving, in (0, 1).

    Args:
        uptime_s: mean time from the start of its service until the machine is preempted.
        recovery_s: mean time from then until a replacement serves.

    Raises:
        LocalError: a value is not positive.
    """
    if not (0 < uptime_s < math.inf and 0 < recovery_s < math.inf):
        raise LocalError("uptime and recovery: expected more than no time, and less than forever")
    return recovery_s / (uptime_s + recovery_s)


def joint(chances: Iterable[float]) -> float:
    """Return the chance that all machines are down at once, if they are independent; 1 without machines."""
    return math.prod(chances)


def replicas_needed(machine: float, target: float) -> int:
    """Return the fewest replicas whose joint failure is at most ``target``.

    Args:
        machine: chance that one replica is down, in (0, 1), independent of the others.
        target: largest joint chance accepted, in (0, 1).

    Raises:
        LocalError: either lies outside (0, 1).
    """
    if not 0 < machine < 1:
        raise LocalError(f"chance of a machine being down: {machine}: expected a number between 0 and 1")
    if not 0 < target < 1:
        raise LocalError(f"target {target}: expected a number between 0 and 1")
    return max(1, math.ceil(math.log(target) / math.log(machine) * (1 - _ROUNDING)))


def joint_in_one_region(chances: Iterable[float], factor: float) -> float:
    """Return the chance that all machines of one region are down at once; 1 for an empty region.

    Args:
        factor: ratio of joint failures of two machines to independent failures; at least 1.

    Raises:
        LocalError: ``factor`` is less than 1.
    """
    if factor < 1:
        raise LocalError(f"factor {factor}: expected at least 1, which is independence")
    first, *others = sorted(chances, reverse=True) or [1.0]
    return first * math.prod(min(1.0, factor * chance) for chance in others)


def joint_over_regions(chances: Mapping[str, Iterable[float]], factor: float) -> float:
    """Return the chance that all machines are down at once; different regions are independent."""
    return joint(joint_in_one_region(each, factor) for each in chances.values())


def more_in_one_region(machine: float, target: float, factor: float, have: Sequence[float] = ()) -> int | None:
    """Return the number of machines to add in the region of ``have`` for a joint failure of at most ``target``.

    Args:
        machine: chance that a new machine is down, in (0, 1).

    Returns:
        None: no number is enough, because with ``factor`` each further machine is down whenever the others are.

    Raises:
        LocalError: a chance or the target lies outside (0, 1), or ``factor`` is less than 1.
    """
    most = len(have) + replicas_needed(machine, target)
    if factor * machine < 1:
        most += replicas_needed(factor * machine, target)
    for more in range(most + 1):
        if joint_in_one_region((*have, *[machine] * more), factor) <= target:
            return more
    return None
