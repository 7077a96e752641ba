"""Tasks of a client: its requests, and the check of an answer; one class a kind of service.

Sans-I/O. The frames are drawn once, when a task is made; only a task with frames loads the libraries that draw them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import ListParameters, SetParameters

if TYPE_CHECKING:
    from vision import Grey, Scene

Request: TypeAlias = "GetPlan.Request | ListParameters.Request | SetParameters.Request"
Response: TypeAlias = "GetPlan.Response | ListParameters.Response | SetParameters.Response"

WARM_UP: Final = -1  # the number of a request whose answer is not checked
_FRAMES: Final = 24  # and then the first one again
_APART_M: Final = 0.005
_TURNED_RAD: Final = 0.03
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

    def __init__(self, problem: str) -> None:
        del problem

    def request(self, number: int) -> Request:
        """Return the request with this number."""
        return ListParameters.Request(prefixes=[_FILL], depth=max(number, 0))

    def judge(self, number: int, response: Response) -> Judged:
        """Return the value of an answer."""
        said, machine, had = response.result.names
        return Judged(machine, 0.0, said == str(number), float(had))


class Look:
    """Request for what a scene shows; ``is_right`` judges an answer. Note: the number of words."""

    kind = SetParameters

    def __init__(self, is_right: Callable[[Mapping[str, Any], Scene], bool]) -> None:
        from vision import Scene

        self._is_right = is_right
        self._scenes = [Scene.draw(seed) for seed in range(_FRAMES)]

    def request(self, number: int) -> Request:
        """Return the request with this number."""
        return _request(self._scenes[number % _FRAMES].frame, number)

    def judge(self, number: int, response: Response) -> Judged:
        """Return the value of an answer."""
        said, scene = _said(response), self._scenes[number % _FRAMES]
        return _judged(said, is_right=self._is_right(said, scene), note=len(scene.words))


class Tag:
    """Request for the pose of the tag; right is within 5 mm and 0.03 rad of the drawn one. Note: metres apart."""

    kind = SetParameters

    def __init__(self, problem: str) -> None:
        del problem
        from tag import Pose, TagCamera

        camera = TagCamera()
        self._poses = [Pose.on_its_way(3 * number) for number in range(_FRAMES)]
        self._frames = [camera.draw(pose) for pose in self._poses]

    def request(self, number: int) -> Request:
        """Return the request with this number."""
        return _request(self._frames[number % _FRAMES], number)

    def judge(self, number: int, response: Response) -> Judged:
        """Return the value of an answer."""
        from tag import Pose

        said, truth = _said(response), self._poses[number % _FRAMES]
        turn, at = said.get("turn"), said.get("at")
        if not isinstance(turn, list) or not isinstance(at, list):
            return _judged(said, is_right=False)
        found = Pose(tuple(turn), tuple(at))
        apart_m = found.apart_m(truth)
        return _judged(said, is_right=apart_m <= _APART_M and found.turned_rad(truth) <= _TURNED_RAD, note=apart_m)


def _covers(said: Mapping[str, Any], scene: Scene) -> bool:
    from image_request import mask_in

    return scene.is_covered(mask_in(said["mask"]))


def _request(frame: Grey, number: int) -> SetParameters.Request:
    from image_request import request_of

    return request_of(frame, number)


def _said(response: Response) -> dict[str, Any]:
    from image_request import said_in

    return said_in(response)


def _judged(said: Mapping[str, Any], *, is_right: bool, note: float = 0.0) -> Judged:
    return Judged(said["machine"], said["worked_s"], is_right, note)


Task: TypeAlias = "Plan | Number | Look | Tag"

TASKS: Final[Mapping[str, Callable[[str], Task]]] = {
    "plan": Plan,
    "number": Number,
    "detect": lambda _: Look(lambda said, scene: scene.agrees(said["found"])),
    "segment": lambda _: Look(_covers),
    "count": lambda _: Look(lambda said, scene: said["words"] == len(scene.words)),
    "tag": Tag,
}
