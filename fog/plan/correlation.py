"""Joint failure of machines when failures within one region are correlated.

Sans-I/O; numbers in, numbers out.
Model: the first machine of a region is down with its own chance. Each further machine is down ``factor`` times as often
as alone while the machines before it are down: P = p1 * min(1, factor * p2) * min(1, factor * p3) * ... Chances of
different regions multiply. With the largest factor of a pair, the model exceeds the measurement for three machines in
the same traces (13.6 times independence against 7.0; ``fog.plan.evidence``). The model does not cover joint failures of
regions: there are no data for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from fog.plan.failure import joint, replicas_needed
from gdp.errors import LocalError


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
