"""What a client asks for, and how it tells a right answer from a wrong one: one class a kind of service.

Sans-I/O. The frames are drawn once, when a task is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias

from image_request import request_of, said_in
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import SetParameters
from vision import Scene

__all__ = ["TASKS", "WARM_UP", "Judged", "Request", "Response", "Task"]

Request: TypeAlias = "GetPlan.Request | SetParameters.Request"
Response: TypeAlias = "GetPlan.Response | SetParameters.Response"

WARM_UP: Final = -1  # the number of a request whose answer is not looked at
_FRAMES: Final = 24  # and then the first one again
_APART_M: Final = 0.005
_TURNED_RAD: Final = 0.03
_NANO: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Judged:
    """What an answer is worth; as in ``samples.Sample``."""

    machine: str
    worked_s: float
    is_right: bool
    note: float = 0.0


class Task(Protocol):
    """A kind of request."""

    kind: type[GetPlan] | type[SetParameters]

    def request(self, number: int) -> Request:
        """Return the request of a number."""
        ...

    def judge(self, number: int, response: Response) -> Judged:
        """Return what an answer to the request of that number is worth."""
        ...


class Plan:
    """Ask for a way; right is one that begins and ends somewhere. Note: how many places it has."""

    kind = GetPlan

    def __init__(self, problem: str) -> None:
        self._problem = problem

    def request(self, number: int) -> Request:
        """Return the request of a number."""
        request = GetPlan.Request()
        if number != WARM_UP:  # else no problem at all, which is solved at once
            request.start.header.frame_id = self._problem
            request.goal.header.stamp.sec = number
        return request

    def judge(self, number: int, response: Response) -> Judged:
        """Return what an answer is worth."""
        del number
        head, count = response.plan.header, len(response.plan.poses)
        return Judged(head.frame_id, head.stamp.sec + head.stamp.nanosec * _NANO, count > 0, count)


class Detect:
    """Ask where the objects of a scene are; right is each of them and nothing else. Note: how many there are."""

    kind = SetParameters

    def __init__(self, problem: str) -> None:
        del problem
        self._scenes = [Scene.draw(seed) for seed in range(_FRAMES)]

    def request(self, number: int) -> Request:
        """Return the request of a number."""
        return request_of(self._scenes[number % _FRAMES].frame, number)

    def judge(self, number: int, response: Response) -> Judged:
        """Return what an answer is worth."""
        said, scene = said_in(response), self._scenes[number % _FRAMES]
        found = said["found"]
        is_right = isinstance(found, list) and scene.agrees([(row, column) for row, column in found])
        return _judged(said, is_right=is_right, note=len(scene.centres))


class Segment(Detect):
    """Ask into how many regions a scene falls; right is the number of objects drawn, which is also the note."""

    def judge(self, number: int, response: Response) -> Judged:
        """Return what an answer is worth."""
        said, count = said_in(response), len(self._scenes[number % _FRAMES].centres)
        return _judged(said, is_right=said["regions"] == count, note=count)


class Tag:
    """Ask where the tag of a frame is; right is within 5 mm and 0.03 rad of where it was drawn. Note: metres apart."""

    kind = SetParameters

    def __init__(self, problem: str) -> None:
        del problem
        from tag import Pose, TagCamera

        camera = TagCamera()
        self._poses = [Pose.on_its_way(3 * number) for number in range(_FRAMES)]
        self._frames = [camera.draw(pose) for pose in self._poses]

    def request(self, number: int) -> Request:
        """Return the request of a number."""
        return request_of(self._frames[number % _FRAMES], number)

    def judge(self, number: int, response: Response) -> Judged:
        """Return what an answer is worth."""
        from tag import Pose

        said, truth = said_in(response), self._poses[number % _FRAMES]
        turn, at = said.get("turn"), said.get("at")
        if not isinstance(turn, list) or not isinstance(at, list):
            return _judged(said, is_right=False)
        found = Pose(tuple(turn), tuple(at))
        apart_m = found.apart_m(truth)
        return _judged(said, is_right=apart_m <= _APART_M and found.turned_rad(truth) <= _TURNED_RAD, note=apart_m)


TASKS: Final[Mapping[str, Callable[[str], Task]]] = {
    "plan": Plan,
    "detect": Detect,
    "segment": Segment,
    "tag": Tag,
}


def _judged(said: Mapping[str, object], *, is_right: bool, note: float = 0.0) -> Judged:
    return Judged(str(said["machine"]), float(str(said["worked_s"])), is_right, note)
