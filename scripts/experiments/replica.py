"""Service nodes of the experiments: ordinary rclpy nodes without knowledge of the overlay.

Process of its own, started by ``field.py`` or ``fog`` on a machine: ``replica.py ROLE SETTINGS``.

``plan`` and ``replay`` serve ``nav_msgs/srv/GetPlan``. The request's start names the problem in its ``frame_id``; an
unknown problem is answered at once, without a path. The stamp of its goal holds the number of the request in seconds.
The answer's header names the machine, and its stamp is the computing time. Both stop when the service's ``/stop`` is
called (``std_srvs/srv/Trigger``). ``detect``, ``segment``, ``count`` and ``tag`` serve what ``image_request.py``
describes, one request at a time.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import bench_path  # noqa: F401 - finds ``peers``
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from image_request import answer_of, frame_of, text_of
from nav_msgs.srv import GetPlan
from peers.jsonl import say
from rcl_interfaces.srv import SetParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger
from vision import Grey, Networks, count_words

_THREADS: Final = 32
Settings = Mapping[str, Any]


class _Service:
    """``GetPlan`` service and its ``/stop``: the requests in progress, each with a flag that it is no longer wanted."""

    def __init__(self, planner: _Planner, node: Node, name: str, machine: str) -> None:
        self._planner = planner
        self._machine = machine
        self._flags: set[threading.Event] = set()
        self._lock = threading.Lock()
        group = ReentrantCallbackGroup()
        node.create_service(GetPlan, name, self._answer, callback_group=group)
        node.create_service(Trigger, f"{name}/stop", self._stop, callback_group=group)

    def _answer(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        begun_s, flag = time.monotonic(), threading.Event()
        with self._lock:
            self._flags.add(flag)
        try:
            response.plan.poses = self._planner.way(request, flag)
        finally:
            with self._lock:
                self._flags.discard(flag)
        part_s, whole_s = math.modf(time.monotonic() - begun_s)
        response.plan.header.frame_id = self._machine
        response.plan.header.stamp = Time(sec=int(whole_s), nanosec=int(part_s * 1e9))
        return response

    def _stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        with self._lock:
            response.success = bool(self._flags)
            for flag in self._flags:
                flag.set()
        return response


class _Planner(ABC):
    """Planner that answers ``GetPlan``, and stops on request."""

    def __init__(self, node: Node, settings: Settings) -> None:
        self._services = [_Service(self, node, name, settings["machine"]) for name in _names(settings)]

    @abstractmethod
    def way(self, request: GetPlan.Request, flag: threading.Event) -> list[PoseStamped]:
        """Return the poses of the answer; they do not matter once the flag is raised."""


class _Ompl(_Planner):
    """Planner by OMPL; a request that arrives while another is planned waits for its core, not for a lock."""

    def __init__(self, node: Node, settings: Settings) -> None:
        from planning import Problem, be_quiet

        be_quiet()
        folder, names = Path(settings["folder"]), settings["problems"].split()
        self._problems = {name: Problem.load(folder, name) for name in names}
        self._kind = settings["planner"]
        self._patience_s = settings["patience_s"]
        super().__init__(node, settings)

    def way(self, request: GetPlan.Request, flag: threading.Event) -> list[PoseStamped]:
        problem = self._problems.get(request.start.header.frame_id)
        if problem is None:
            return []
        found = problem.solve(self._kind, self._patience_s, flag.is_set)
        return [_stamped(each) for each in found.way or []]


class _Replay(_Planner):
    """Server that waits as long as a recording states, and computes nothing: the figure is the overlay's part alone."""

    def __init__(self, node: Node, settings: Settings) -> None:
        waits = settings["waits_s"]
        self._waits_s: dict[str, list[float]] = waits if isinstance(waits, dict) else {}
        super().__init__(node, settings)

    def way(self, request: GetPlan.Request, flag: threading.Event) -> list[PoseStamped]:
        if waits_s := self._waits_s.get(request.start.header.frame_id):
            flag.wait(waits_s[request.goal.header.stamp.sec % len(waits_s)])
        return [PoseStamped()]


def _look(node: Node, settings: Settings, see: Callable[[Grey], Mapping[str, object]]) -> None:
    machine = settings["machine"]

    def answer(request: SetParameters.Request, response: SetParameters.Response) -> SetParameters.Response:
        del response
        begun_s = time.monotonic()
        said = see(frame_of(request))
        return answer_of({"machine": machine, "worked_s": time.monotonic() - begun_s, **said})

    for name in _names(settings):
        node.create_service(SetParameters, name, answer)


def _detect(node: Node, settings: Settings) -> None:
    networks = Networks()
    _look(node, settings, lambda frame: {"found": networks.detect(frame)})


def _segment(node: Node, settings: Settings) -> None:
    networks = Networks()
    _look(node, settings, lambda frame: {"mask": text_of(networks.segment(frame))})


def _count(node: Node, settings: Settings) -> None:
    """Count words without a network, and wait for the rest of the request's time, as if another processor worked."""
    times = settings["takes_s"]
    takes_s = itertools.cycle(times if isinstance(times, list) else [])

    def see(frame: Grey) -> dict[str, object]:
        done_s = time.monotonic() + next(takes_s)
        words = count_words(frame)
        time.sleep(max(done_s - time.monotonic(), 0))
        return {"words": words}

    _look(node, settings, see)


def _tag(node: Node, settings: Settings) -> None:
    from tag import TagCamera

    camera = TagCamera()

    def see(frame: Grey) -> dict[str, object]:
        pose = camera.find(frame)
        return {} if pose is None else {"turn": pose.turn, "at": pose.at}

    _look(node, settings, see)


_ROLES: Final[Mapping[str, Callable[[Node, Settings], object]]] = {
    "plan": _Ompl,
    "replay": _Replay,
    "detect": _detect,
    "segment": _segment,
    "count": _count,
    "tag": _tag,
}


def _names(settings: Settings) -> list[str]:
    return str(settings["services"]).split()


def _stamped(place: tuple[float, ...]) -> PoseStamped:
    x, y, z, *turn = place
    qx, qy, qz, qw = turn
    pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    return PoseStamped(pose=pose)


def main() -> None:
    """Serve until killed."""
    role, settings = sys.argv[1], {"machine": os.getenv("FOG_MACHINE"), **json.loads(sys.argv[2])}
    rclpy.init()
    node = Node(f"replica_{role}")
    executor = MultiThreadedExecutor(_THREADS) if role in ("plan", "replay") else SingleThreadedExecutor()
    executor.add_node(node)
    serving = _ROLES[role](node, settings)
    say(event="ready")
    try:
        executor.spin()
    except ExternalShutdownException:
        del serving


if __name__ == "__main__":
    main()
