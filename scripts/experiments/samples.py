"""Series of requests, their samples, and statistics: mean, p99, and the least of two that arithmetic predicts.

Sans-I/O.
Source: FogROS2-FT (IROS 2024), whose figures compare mean and 99th percentile of one server and of two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean

import bench_path  # noqa: F401 - finds ``report``
from report import percentile

p99 = partial(percentile, share=0.99)  # of fewer than a hundred values the largest


@dataclass(frozen=True, slots=True)
class Series:
    """Calls of several services in turn; each round of them carries the same request.

    Args:
        task: a kind of request in ``tasks.task_of``.
        count: of calls in all.
        machines: each has answered a call before the series begins.
        patience_s: after which a call has failed.
        lanes: most calls at a time.
        gap_s: least time between the beginnings of two calls.
        warm_up: least number of calls before the series.
        problem: for the task ``plan``.
        counts_answers: whether to count the answers that reach each call.
    """

    task: str
    services: tuple[str, ...]
    count: int
    machines: tuple[str, ...]
    patience_s: float
    lanes: int = 1
    gap_s: float = 0.0
    warm_up: int = 4
    problem: str = ""
    counts_answers: bool = False


@dataclass(frozen=True, slots=True)
class Sample:
    """One request.

    Args:
        service: the name that was called.
        begun_s: start, in monotonic seconds of the host.
        latency_s: until the caller had the answer; of a failed one, until the failure was known.
        machine: the machine that answered; empty: none.
        worked_s: computing time that the server reports.
        is_right: the answer is there and is right.
        note: a property of the answer, for the experiment.
    """

    service: str
    begun_s: float
    latency_s: float
    machine: str
    worked_s: float
    is_right: bool
    note: float = 0.0


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of latencies, in seconds."""

    count: int
    failed: int
    mean_s: float
    p50_s: float
    p99_s: float
    worst_s: float

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> Summary:
        """Return the summary of one request or more; failed ones count with the time that they cost.

        Raises ``ValueError``: none at all.
        """
        times = [each.latency_s for each in samples]
        failed = sum(not each.is_right for each in samples)
        return cls(len(times), failed, fmean(times), percentile(times, 0.5), p99(times), max(times))


def least_of_two(values: Sequence[float]) -> list[float]:
    """Return the smaller one of every pair of values: two independent servers, without any overlay."""
    ordered = sorted(values)
    return [small for at, small in enumerate(ordered) for _ in ordered[at + 1 :]]
