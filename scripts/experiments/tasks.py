"""Tasks of a client: its requests, and the check of an answer; one class a kind of service.

Sans-I/O. Only a task with frames loads the libraries that draw them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import ListParameters, SetParameters

Request: TypeAlias = "GetPlan.Request | ListParameters.Request | SetParameters.Request"
Response: TypeAlias = "GetPlan.Response | ListParameters.Response | SetParameters.Response"

WARM_UP: Final = -1  # the number of a request whose answer is not checked
_NANO: Final = 1e-9
_FILL: Final = "x" * 79  # 4 encapsulation, 4 count, 4 length, 80 text with its end, 8 depth: 100


@dataclass(frozen=True, slots=True)
class Judged:
    """Value of an answer; as in ``samples.Sample``."""

    machine: str
    worked_s: float
    is_right: bool
    note: float = 0.0


class Plan:
    """Request for a path; right is one that begins and ends somewhere. Note: the number of its poses."""

    kind = GetPlan

    def __init__(self, problem: str) -> None:
        self._problem = problem

    def request(self, number: int) -> Request:
        """Return the request with this number."""
        request = GetPlan.Request()
        if number != WARM_UP:  # else no problem at all, which is solved at once
            request.start.header.frame_id = self._problem
            request.goal.header.stamp.sec = number
        return request

    def judge(self, number: int, response: Response) -> Judged:
        """Return the value of an answer."""
        del number
        head, count = response.plan.header, len(response.plan.poses)
        return Judged(head.frame_id, head.stamp.sec + head.stamp.nanosec * _NANO, count > 0, count)


class Number:
    """Request of 100 bytes with its number; right is the same number. Note: requests that the machine has had."""

    kind = ListParameters

    def request(self, number: int) -> Request:
        """Return the request with this number."""
        return ListParameters.Request(prefixes=[_FILL], depth=max(number, 0))

    def judge(self, number: int, response: Response) -> Judged:
        """Return the value of an answer."""
        said, machine, had = response.result.names
        return Judged(machine, 0.0, said == str(number), float(had))


class Look:
    """Request for what a frame shows; ``name``: of ``frames.FRAME_TASKS``, which has the note, too."""

    kind = SetParameters

    def __init__(self, name: str) -> None:
        from frames import FRAME_TASKS

        self._task = FRAME_TASKS[name]
        self._drawn = self._task.draw()

    def request(self, number: int) -> Request:
        """Return the request with this number."""
        from frames import request_of

        return request_of(self._drawn[number % len(self._drawn)][0], number)

    def judge(self, number: int, response: Response) -> Judged:
        """Return the value of an answer."""
        from frames import said_in

        said = said_in(response)
        return Judged(
            said["machine"], said["worked_s"], *self._task.judge(said, self._drawn[number % len(self._drawn)][1])
        )


Task: TypeAlias = "Plan | Number | Look"


def task_of(kind: str, problem: str = "") -> Task:
    """Return a task: ``plan``, with its problem, ``number``, or one with frames."""
    return Plan(problem) if kind == "plan" else Number() if kind == "number" else Look(kind)
