"""The same where machines in one region fail together more often than independence says.

Sans-I/O; numbers in, numbers out.
Model: of machines in one region, the first is down with its own chance, and each further one ``factor`` times as often
as alone while those before it are down: P = p1 * min(1, factor * p2) * min(1, factor * p3) * ... Different regions
multiply. With the largest factor of a pair this lies above what three machines did in the traces that it was measured
from (13.6 times independence against 7.0; ``fog.plan.evidence``). It says nothing of regions that fail together:
there are no data for that.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from fog.plan.failure import joint, replicas_needed
from gdp.errors import LocalError

__all__ = ["joint_in_one_region", "joint_over_regions", "more_in_one_region"]


def joint_in_one_region(chances: Iterable[float], factor: float) -> float:
    """Return the chance that all machines of one region are down at once; 1 for no machine at all.

    Args:
        factor: how many times as often as independent ones two of them are down together; at least 1.

    Raises:
        LocalError: ``factor`` is less than 1.
    """
    if factor < 1:
        raise LocalError(f"factor {factor}: expected at least 1, which is independence")
    first, *others = sorted(chances, reverse=True) or [1.0]
    return first * math.prod(min(1.0, factor * chance) for chance in others)


def joint_over_regions(chances: Mapping[str, Iterable[float]], factor: float) -> float:
    """Return the chance that all machines are down at once, given each region's; regions are independent."""
    return joint(joint_in_one_region(each, factor) for each in chances.values())


def more_in_one_region(machine: float, target: float, factor: float, have: Sequence[float] = ()) -> int | None:
    """Return how many to add, all in one region with ``have``, until their joint failure is at most ``target``.

    Args:
        machine: chance that one of the new ones is down, in (0, 1).
        have: the chances of those there already.

    Returns:
        None: no number is enough, because with ``factor`` a further one is down whenever those before it are.

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
