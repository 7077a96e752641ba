"""Service nodes of the experiments: ordinary rclpy nodes without knowledge of the overlay.

Process of its own, started by ``field.py`` or ``fog`` on a machine: ``replica.py ROLE SETTINGS``.

``plan`` and ``replay`` serve ``nav_msgs/srv/GetPlan``. The request's start names the problem in its ``frame_id``; an
unknown problem is answered at once, without a path. The stamp of its goal holds the number of the request in seconds.
The answer's header names the machine, and its stamp is the computing time. Both stop when the service's ``/stop`` is
called (``std_srvs/srv/Trigger``). The other roles serve the tasks of ``frames.py``, one request at a time.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeAlias

import bench_path  # noqa: F401 - finds ``peers``
import rclpy
from builtin_interfaces.msg import Time
from frames import FRAME_TASKS, answer_of, frame_of
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.srv import GetPlan
from peers.jsonl import say
from rcl_interfaces.srv import SetParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

_THREADS: Final = 32
Settings: TypeAlias = "Mapping[str, Any]"
Way: TypeAlias = "Callable[[GetPlan.Request, threading.Event], list[PoseStamped]]"  # the flag: it is no longer wanted


def _serve_plans(node: Node, name: str, machine: str, way: Way) -> None:
    """Serve ``GetPlan`` and its ``/stop``, which raises the flags of the requests in progress."""
    flags: set[threading.Event] = set()
    lock, group = threading.Lock(), ReentrantCallbackGroup()

    def answer(request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        begun_s, flag = time.monotonic(), threading.Event()
        with lock:
            flags.add(flag)
        try:
            response.plan.poses = way(request, flag)
        finally:
            with lock:
                flags.discard(flag)
        part_s, whole_s = math.modf(time.monotonic() - begun_s)
        response.plan.header.frame_id = machine
        response.plan.header.stamp = Time(sec=int(whole_s), nanosec=int(part_s * 1e9))
        return response

    def stop(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with lock:
            response.success = bool(flags)
            for flag in flags:
                flag.set()
        return response

    node.create_service(GetPlan, name, answer, callback_group=group)
    node.create_service(Trigger, f"{name}/stop", stop, callback_group=group)


def _plan(settings: Settings) -> Way:
    """Plan by OMPL; a request that arrives while another is planned waits for its core, not for a lock."""
    from planning import Problem, be_quiet

    be_quiet()
    problems = {name: Problem.load(Path(settings["folder"]), name) for name in settings["problems"].split()}

    def way(request: GetPlan.Request, flag: threading.Event) -> list[PoseStamped]:
        problem = problems.get(request.start.header.frame_id)
        if problem is None:
            return []
        return [_stamped(*each) for each in problem.solve(settings["planner"], settings["patience_s"], flag.is_set)]

    return way


def _replay(settings: Settings) -> Way:
    """Wait as long as a recording states, and compute nothing: the figure is the overlay's part alone."""

    def way(request: GetPlan.Request, flag: threading.Event) -> list[PoseStamped]:
        if waits_s := settings["waits_s"].get(request.start.header.frame_id):
            flag.wait(waits_s[request.goal.header.stamp.sec % len(waits_s)])
        return [PoseStamped()]

    return way


_PLANNERS: Final[Mapping[str, Callable[[Settings], Way]]] = {"plan": _plan, "replay": _replay}


def _serve_frames(node: Node, name: str, machine: str, see: Callable[[Any], Mapping[str, object]]) -> None:
    def answer(request: SetParameters.Request, _: SetParameters.Response) -> SetParameters.Response:
        begun_s = time.monotonic()
        said = see(frame_of(request))
        return answer_of({"machine": machine, "worked_s": time.monotonic() - begun_s, **said})

    node.create_service(SetParameters, name, answer)


def _stamped(x: float, y: float, z: float, qx: float, qy: float, qz: float, qw: float) -> PoseStamped:
    pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    return PoseStamped(pose=pose)


def main() -> None:
    """Serve until killed."""
    role, settings = sys.argv[1], {"machine": os.getenv("FOG_MACHINE"), **json.loads(sys.argv[2])}
    rclpy.init()
    node = Node(f"replica_{role}")
    executor = MultiThreadedExecutor(_THREADS) if role in _PLANNERS else SingleThreadedExecutor()
    executor.add_node(node)
    serve: Callable[..., None] = _serve_plans if role in _PLANNERS else _serve_frames
    work = _PLANNERS[role](settings) if role in _PLANNERS else FRAME_TASKS[role].see_with(settings)
    for name in settings["services"].split():
        serve(node, name, settings["machine"], work)
    say(event="ready")
    with suppress(ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    main()
