"""Worker process of interface discovery: starts nodes, polls their graph until no change occurs, and ends them.

I/O. ``python -m fog.launch.interface_discovery_worker FOLDER``. It is a separate process because the ROS domain and the
discovery range apply to a whole process. It reads the nodes from standard input and writes one line of JSON:
``{"offered": [[kind, name, type], ...]}`` or ``{"error": ...}``.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, TypedDict

from fog.child_environment import child_environment
from gdp.errors import LocalError
from gdp.intervals import STOP_S
from gdp.ports.readiness import readable
from gdp.ros_names import is_of_every_node
from proxy.bridge.core.action_interface import action_of, is_part
from proxy.endpoints.core.endpoint import Graph, Role
from proxy.endpoints.ros2 import Ros2Endpoint

PATIENCE_S: Final = 30.0
QUIET_S: Final = 2.0  # after the last change; a node rarely takes longer between two of its services
_LINES: Final = 8


class _Start(TypedDict):
    argv: list[str]
    environment: dict[str, str]


def main() -> None:
    """Read one request and write its result."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    question = json.load(sys.stdin)
    try:
        answer: Mapping[str, object] = {"offered": _seen(question["domain"], question["nodes"], Path(sys.argv[1]))}
    except LocalError as error:
        answer = {"error": str(error)}
    sys.stdout.write(json.dumps(answer) + "\n")


def offers(graph: Graph) -> list[tuple[str, str, str]]:
    """Return (kind, name, type) of all services and actions that have a server in a graph."""
    found = set()
    for end in graph:
        if end.role is Role.SERVES and end.type_name:
            if action := action_of(end):
                found.add(("action", *action))
            elif not is_part(end.name) and not is_of_every_node("service", end.name):
                found.add(("service", end.name, end.type_name))
    return sorted(found)


def _seen(domain: int, nodes: Sequence[_Start], folder: Path) -> list[tuple[str, str, str]]:
    endpoint = Ros2Endpoint(domain, "fog_probe")
    try:
        with ExitStack() as stack:
            ends = dict(stack.enter_context(_started(each, folder / f"{n}.log")) for n, each in enumerate(nodes))
            return _settled(endpoint, ends)
    finally:
        endpoint.shut_down()


def _settled(endpoint: Ros2Endpoint, ends: Mapping[int, Path]) -> list[tuple[str, str, str]]:
    """Wait until an interface is offered and no further one appears.

    Args:
        ends: descriptor that becomes readable when a node ends -> its output.
    """
    begin_s = news_s = time.monotonic()
    before: list[tuple[str, str, str]] = []
    while True:
        now_s = time.monotonic()
        until_s = news_s + QUIET_S if before else begin_s + PATIENCE_S
        if now_s >= until_s:
            break
        ready = readable([endpoint.fileno(), *ends], until_s - now_s)
        for ended in ends.keys() & set(ready):
            raise LocalError(f"a node ended: {_last(ends[ended])}")
        endpoint.poll_events()
        if (found := offers(endpoint.graph())) != before:
            before, news_s = found, time.monotonic()
    if not before:
        raise LocalError(
            f"the nodes offer no service and no action within {PATIENCE_S:g} s: name what they offer,"
            ' such as services={"/plan": "nav_msgs/srv/GetPlan"}'
        )
    return before


@contextmanager
def _started(start: _Start, log: Path) -> Iterator[tuple[int, Path]]:
    with log.open("wb") as output:
        process = subprocess.Popen(
            start["argv"],
            env={**child_environment(os.environ), **start["environment"]},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    descriptor = os.pidfd_open(process.pid)
    try:
        yield descriptor, log
    finally:
        os.close(descriptor)
        process.send_signal(signal.SIGINT)  # ROS nodes end on SIGINT
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _last(log: Path) -> str:
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return " | ".join(lines[-_LINES:]) or "it said nothing"


if __name__ == "__main__":
    main()
