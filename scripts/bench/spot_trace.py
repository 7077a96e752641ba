"""Analysis of recorded spot traces: preemptions, and the simulated availability of a pool.

Sans-I/O; randomness is an argument, a ``numpy`` generator.
Source of the format: the traces published with "Can't Be Late: Optimizing Spot Instance Savings under Deadlines"
(NSDI 2024); as in its simulator, 1 means "no spot machine available".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Steps = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Trace:
    """Trace of one zone; ``taken``: for each step, whether no spot machine was available."""

    zone: str
    step_s: float
    taken: Steps

    @classmethod
    def from_document(cls, zone: str, document: Mapping[str, Any]) -> Trace:
        """Read the published form: ``{"metadata": {"gap_seconds": ...}, "data": [0, 1, ...]}``."""
        return cls(zone, float(document["metadata"]["gap_seconds"]), np.asarray(document["data"], dtype=np.bool_))

    @property
    def preemptions(self) -> list[int]:
        """Return the steps at which a running machine was preempted."""
        return [int(step) for step in np.flatnonzero(self.taken[1:] & ~self.taken[:-1]) + 1]


@dataclass(frozen=True, slots=True)
class Share:
    """Share of time, with the interval that contains 95 % of the resamples."""

    share: float
    low: float
    high: float


def replica_down(trace: Trace, recovery_s: float) -> Steps:
    """Return the steps in which a replica fixed to its zone is down: without a machine, and ``recovery_s`` longer."""
    late = _steps(trace, recovery_s)
    down: Steps = trace.taken.copy()
    for back in np.flatnonzero(trace.taken[:-1] & ~trace.taken[1:]) + 1:
        down[back : back + late] = True
    return down


def outages(trace: Trace, recovery_s: float) -> Steps:
    """Return the ``recovery_s`` after each preemption, for a replica that is replaced in any zone with capacity."""
    late = _steps(trace, recovery_s)
    down = np.zeros_like(trace.taken)
    for lost in trace.preemptions:
        down[lost : lost + late] = True
    return down


def pool_down(traces: Sequence[Trace], replicas: int, recovery_s: float) -> Steps:
    """Return the steps in which a pool that may change zones has no replica up.

    The pool wants ``replicas`` spot machines. A preempted machine is replaced at once and serves ``recovery_s`` later.
    The replacement is in the zone with the fewest machines of the pool among the zones with capacity. It waits while no
    zone has capacity.
    """
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
    """Return the steps in which all are down at once."""
    return np.asarray(np.logical_and.reduce(downs), dtype=np.bool_)


def share_with_interval(down: Steps, block: int, resamples: int, chance: np.random.Generator) -> Share:
    """Return the share of true steps with a moving-block bootstrap interval; blocks preserve runs.

    Args:
        block: steps per block: longer than an outage, much shorter than the trace.
    """
    sums = np.concatenate(([0], np.cumsum(down, dtype=np.int64)))
    blocks = sums[block:] - sums[:-block]
    count = -(-len(down) // block)
    picks = chance.integers(0, len(blocks), size=(resamples, count))
    shares = blocks[picks].sum(axis=1) / (count * block)
    low, high = np.quantile(shares, [0.025, 0.975])
    return Share(float(down.mean()), float(low), float(high))


def _steps(trace: Trace, span_s: float) -> int:
    """Return a duration in whole steps, rounded up."""
    return int(-(-span_s // trace.step_s))
