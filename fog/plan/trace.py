"""What a recorded trace of spot machines says: how long they stay, how they fail together, how a pool would have done.

Sans-I/O; chance comes in as a ``numpy`` generator.
Source of the format: the traces published with "Can't Be Late: Optimizing Spot Instance Savings under Deadlines"
(NSDI 2024); its simulator takes 1 as "no spot machine to be had", and so does this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gdp.errors import LocalError

__all__ = [
    "Share",
    "Trace",
    "none_up",
    "outages",
    "pool_down",
    "replica_down",
    "share_with_interval",
    "times_independent",
]

Steps = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Trace:
    """One zone.

    Args:
        taken: for each step, whether no spot machine was to be had.
    """

    zone: str
    step_s: float
    taken: Steps

    @classmethod
    def from_document(cls, zone: str, document: object) -> Trace:
        """Read the published form: ``{"metadata": {"gap_seconds": ...}, "data": [0, 1, ...]}``.

        Raises:
            LocalError: it is not of that form.
        """
        match document:
            case {"metadata": {"gap_seconds": int() | float() as step_s}, "data": [_, *_] as data} if (
                step_s > 0 and all(each in (0, 1) for each in data)
            ):
                return cls(zone, float(step_s), np.asarray(data, dtype=np.bool_))
        raise LocalError(f"{zone}: not a trace: expected metadata.gap_seconds, and data of 0 and 1")

    @property
    def preemptions(self) -> list[int]:
        """The steps at which a machine that ran was taken."""
        return [int(step) for step in np.flatnonzero(self.taken[1:] & ~self.taken[:-1]) + 1]

    @property
    def uptime_s(self) -> float:
        """Mean time for which a machine ran; infinite if none was ever taken."""
        lost = len(self.preemptions)
        return float(np.count_nonzero(~self.taken)) * self.step_s / lost if lost else float("inf")


@dataclass(frozen=True, slots=True)
class Share:
    """A share of time, with the interval that 95 % of resamples lie in."""

    share: float
    low: float
    high: float


def times_independent(*steps: Steps) -> float:
    """Return how many times as often as independent ones these are all true at once; ``nan`` if one never is."""
    expected = float(np.prod([each.mean() for each in steps]))
    return float(np.logical_and.reduce(steps).mean()) / expected if expected else float("nan")


def replica_down(trace: Trace, recovery_s: float) -> Steps:
    """Return when a replica that stays in its zone does not serve: while none is to be had, and ``recovery_s`` more."""
    late = _steps(trace, recovery_s)
    down: Steps = trace.taken.copy()
    for back in np.flatnonzero(trace.taken[:-1] & ~trace.taken[1:]) + 1:
        down[back : back + late] = True
    return down


def outages(trace: Trace, recovery_s: float) -> Steps:
    """Return the ``recovery_s`` after each preemption, as for a replica that is replaced wherever there is room."""
    late = _steps(trace, recovery_s)
    down = np.zeros_like(trace.taken)
    for lost in trace.preemptions:
        down[lost : lost + late] = True
    return down


def pool_down(traces: Sequence[Trace], replicas: int, recovery_s: float, on_demand: int = 0) -> Steps:
    """Return when a pool that moves has no replica up.

    It wants ``replicas`` spot machines. One that is taken is replaced at once in the zone with the fewest of ours among
    those that have room, and serves ``recovery_s`` later; while no zone has room it waits for one.

    Args:
        on_demand: machines beside them that are never taken.
    """
    if on_demand:
        return np.zeros_like(traces[0].taken)
    late = _steps(traces[0], recovery_s)
    taken = np.stack([trace.taken for trace in traces])
    places = [-1] * replicas
    ready = [0] * replicas
    down = np.zeros_like(traces[0].taken)
    for step in range(taken.shape[1]):
        for at, place in enumerate(places):
            if place >= 0 and not taken[place, step]:
                continue
            free = [zone for zone in range(len(traces)) if not taken[zone, step]]
            places[at] = min(free, key=places.count) if free else -1
            ready[at] = step + (late if step else 0)
        down[step] = not any(place >= 0 and since <= step for place, since in zip(places, ready, strict=True))
    return down


def none_up(downs: Sequence[Steps]) -> Steps:
    """Return when all are down at once."""
    return np.asarray(np.logical_and.reduce(downs), dtype=np.bool_)


def share_with_interval(down: Steps, block: int, resamples: int, chance: np.random.Generator) -> Share:
    """Return the share of steps that are true, with a moving-block bootstrap interval: blocks keep runs whole.

    Args:
        block: steps of a block: longer than an outage, much shorter than the trace.
    """
    sums = np.concatenate(([0], np.cumsum(down, dtype=np.int64)))
    blocks = sums[block:] - sums[:-block]
    count = -(-len(down) // block)
    picks = chance.integers(0, len(blocks), size=(resamples, count))
    shares = blocks[picks].sum(axis=1) / (count * block)
    low, high = np.quantile(shares, [0.025, 0.975])
    return Share(float(down.mean()), float(low), float(high))


def _steps(trace: Trace, span_s: float) -> int:
    """Return a span in whole steps, upwards."""
    return int(-(-span_s // trace.step_s))
