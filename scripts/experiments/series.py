"""Settings of a client at the robot: a series of calls.

Sans-I/O. They are passed to the process of the client as JSON.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Series:
    """Calls of several services in turn; each round of them carries the same request.

    Args:
        task: a kind of request in ``tasks.TASKS``.
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
