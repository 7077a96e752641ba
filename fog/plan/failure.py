"""Replica count for a target availability, if machines fail independently.

Sans-I/O; numbers in, numbers out.
Source: FogROS2-FT, the section on spot machines. P_VM = recovery / (uptime + recovery), P_system = product of all P_i,
N = ceil(log P_system / log P_VM). The paper prints the ratio of logarithms inverted; this form follows from its own
product formula and gives its worked figure (15 h up, 20 min to recover: two spot machines are under 0.05 %).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
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
