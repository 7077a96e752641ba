"""Mixed pools: the cheapest number of machines of each kind that reaches a target, given those that run already."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fog.plan.failure import joint, replicas_needed
from gdp.errors import LocalError

_MOST_MIXES: Final = 200_000


@dataclass(frozen=True, slots=True)
class Kind:
    """Kind of machine in a pool.

    Args:
        chance: that one machine is down, in (0, 1), independent of all others.
        usd_per_hour: price of one machine; not negative.
    """

    name: str
    chance: float
    usd_per_hour: float


@dataclass(frozen=True, slots=True)
class Mix:
    """Pool of machines.

    Args:
        more: number of each kind to add, in the order of the given kinds.
        chance: that all machines, old and new, are down at once.
    """

    more: tuple[int, ...]
    chance: float
    usd_per_hour: float


def cheapest_mix(kinds: Sequence[Kind], target: float, have: Sequence[float] = ()) -> Mix:
    """Return the machines to add; among equal prices, the mix with fewer machines, then the safer one.

    Args:
        target: largest joint chance accepted, in (0, 1).

    Raises:
        LocalError: there are no kinds, a chance or the target lies outside (0, 1), or there are too many combinations.
    """
    if not kinds or any(kind.usd_per_hour < 0 for kind in kinds):
        raise LocalError("expected at least one kind of machine, and no negative price")
    if not 0 < target < 1:
        raise LocalError(f"target {target:g}: expected a number between 0 and 1")
    already = joint(have)
    minimum = 0 if have else 1
    most = [max(minimum, _alone(kind, target, already)) for kind in kinds]
    if math.prod(each + 1 for each in most) > _MOST_MIXES:
        raise LocalError(f"up to {most} machines of {len(kinds)} kinds: ask for fewer kinds, or for less")
    mixes = (
        Mix(
            more,
            already * joint(kind.chance**count for kind, count in zip(kinds, more, strict=True)),
            sum(kind.usd_per_hour * count for kind, count in zip(kinds, more, strict=True)),
        )
        for more in itertools.product(*(range(each + 1) for each in most))
        if sum(more) >= minimum
    )
    enough = (mix for mix in mixes if mix.chance <= target * (1 + 1e-9))
    return min(enough, key=lambda mix: (round(mix.usd_per_hour, 9), sum(mix.more), mix.chance))


def _alone(kind: Kind, target: float, already: float) -> int:
    """Return the number of machines of one kind that is enough without the others."""
    return 0 if already <= target else replicas_needed(kind.chance, target / already)
