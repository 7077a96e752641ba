"""Live run: real ROS nodes on both sides of the ring, and a proxy in the graph of each. I/O."""

from __future__ import annotations

import importlib.util
import signal
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.credentials import Side
from lab.process import Event, LabProcess
from lab.supervisor import Supervisor
from lab.topology import Attachment
from proxy.endpoints.ros1.install import rospy_folder
from ring.live_plan import MASTER_PORT, Graph, carried_in, graphs_of, messages_in, paces
from ring.nodes.content import LAMP, LAMP_HZ
from ring.options import Live, Options
from ring.overlay import Injection, Overlay
from ring.result import Heard, Result, rows
from ring.traffic import ProgressReporter, Traffic

MEET_S: Final = 60.0
ENDING_S: Final = 30.0
QUIET_S: Final = 5.0
_FIXED: Final = ("lamp", "listener", "caller")  # nodes that are no talkers


class LiveSession:
    """One run's traffic, between nodes that are ready.

    Args:
        supervisor: watches the nodes.
        nodes: by name: ``lamp``, ``listener``, ``caller``, and the talkers.
        messages: that the talkers will publish.
        calls: that the caller will make.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        nodes: Mapping[str, LabProcess],
        messages: int,
        calls: int,
        reporter: ProgressReporter,
    ) -> None:
        self._supervisor = supervisor
        self._lamp, self._listener, self._caller = (nodes[name] for name in _FIXED)
        self._talkers = [node for name, node in nodes.items() if name not in _FIXED]
        self._messages = messages
        self._reporter = reporter
        self.traffic = Traffic(messages + calls)
        for node in (*self._talkers, self._listener, self._caller):
            supervisor.hear(node, self._note)

    def meet(self) -> None:
        """Wait until the remote side receives every topic and discovers the service."""
        for node in (self._listener, self._caller):
            self._supervisor.wait_for(node, "hears", MEET_S)

    def talk(self, seconds: float) -> Heard:
        """Run the traffic for this long, wait for messages under way, and return each node's report."""
        done = partial(self._supervisor.wait_for, name="done")
        self._reporter.begin_traffic(self.traffic.total)
        try:
            for node in (*self._talkers, self._caller):
                node.send(signal.SIGUSR1)
            said = [done(node, patience_s=seconds + ENDING_S) for node in self._talkers]
            called = done(self._caller, patience_s=ENDING_S)
            self.traffic.note_received(LAMP, called["answered"], time.monotonic())
            self._await_quiet(self._messages + called["answered"])
            for node in (self._lamp, self._listener):
                node.send(signal.SIGINT)
            served, heard = (done(node, patience_s=ENDING_S) for node in (self._lamp, self._listener))
        finally:
            self._reporter.close()
        return Heard(tuple(said), served, heard, called)

    def _await_quiet(self, wanted: int) -> None:
        """Wait until everything arrived, or nothing arrived for a while."""
        moved = True
        while moved and (before := self.traffic.received) < wanted:
            moved = self._supervisor.follow(lambda: self.traffic.received != before, QUIET_S)

    def _note(self, child: LabProcess, event: Event) -> None:
        if event["event"] != "progress":
            return
        now_s, traffic = time.monotonic(), self.traffic
        if child is self._listener:
            for each in event["topics"]:
                traffic.note_received(each["topic"], each["received"], now_s)
            traffic.latency_ms = event.get("latency_ms")
        elif child is self._caller:
            traffic.note_sent(LAMP, event["asked"], now_s)
            traffic.note_received(LAMP, event["answered"], now_s)
        else:
            traffic.note_sent(event["topic"], event["sent"], now_s)
        self._reporter.traffic(traffic)


_ROS2: Final = ("rclpy", "std_msgs", "sensor_msgs", "nav_msgs", "std_srvs")
_SIDES: Final[tuple[Side, Side]] = ("expose", "import")


class LiveRing:
    """The ring of one live run, from its creation.

    ``run``: removes what is created here. Raises ``LocalError``: a ROS is missing, or the kernel refuses namespaces.
    """

    def __init__(self, options: Options, live: Live, run: Run, reporter: ProgressReporter) -> None:
        self.graphs = graphs_of(live, run.id)
        _require({graph.ros for graph in self.graphs})
        self._options = options
        self._run = run
        self._reporter = reporter
        self.overlay = Overlay(options, run, reporter)
        self._ends = tuple(zip((self.overlay.robot, self.overlay.server), self.graphs, _SIDES, strict=True))
        self._proxies: list[LabProcess] = []
        self._nodes: dict[str, LabProcess] = {}

    def result(self) -> Result:
        """Run the traffic between robot and server, and compare."""
        overlay, supervisor = self.overlay, self.overlay.supervisor
        overlay.stand_up()
        argv = ["-m", "ring.nodes", "1", "master", str(MASTER_PORT)]
        supervisor.ready(*(self._start(at, graph, "master", argv) for at, graph, _ in self._ends if graph.ros == 1))
        self._proxies = [self._start_proxy(*end) for end in self._ends]
        supervisor.ready(*self._proxies)
        session = self._start_nodes()
        session.meet()
        self._reporter.step(f"they hear each other; {self._options.live_s:g} s of traffic")
        injection, begun_s = Injection(supervisor, self._options.faults, overlay.inject), time.monotonic()
        try:
            heard = session.talk(self._options.live_s)
        finally:
            complaints = injection.stop()
        traffic_s = time.monotonic() - begun_s
        self._reporter.step("comparing what was published with what was heard")
        result = self._compare(heard, complaints)
        return replace(result, traffic_s=traffic_s, silent_s=session.traffic.longest_s)

    def go_on(self) -> None:
        """Replace the proxies that have reported by ones that outlive this process, and continue the nodes' traffic."""
        for end in self._ends:
            self._start_proxy(*end, heard=False)
        for node in self._nodes.values():
            node.send(signal.SIGUSR1)

    def _start_nodes(self) -> LiveSession:
        """Start the nodes; return when all are ready."""
        (robot, at_robot, _), (server, at_server, _) = self._ends
        seconds, talking = self._options.live_s, paces(self._options.camera_hz)
        counts = {name: messages_in(seconds, hz) for name, hz in talking.items()}
        calls = messages_in(seconds, LAMP_HZ)
        self._reporter.step(f"starting nodes at {robot.switch}, ROS {at_robot.ros}: {', '.join(talking)}, lamp")
        self._reporter.step(f"starting nodes at {server.switch}, ROS {at_server.ros}: listener, caller")
        words = {name: [str(counts[name]), str(hz)] for name, hz in talking.items()}
        words |= {"lamp": ["0"], "listener": ["0"], "caller": [str(calls)]}
        for name, more in words.items():
            at, graph = (server, at_server) if name in ("listener", "caller") else (robot, at_robot)
            self._nodes[name] = self._start(at, graph, name, ["-m", "ring.nodes", str(graph.ros), name, *more])
        self.overlay.supervisor.ready(*self._nodes.values())
        return LiveSession(self.overlay.supervisor, self._nodes, sum(counts.values()), calls, self._reporter)

    def _compare(self, heard: Heard, complaints: list[str]) -> Result:
        said = [self._finish(proxy) for proxy in self._proxies]
        result = Result(rows(heard, said[1]["topics"]), self.overlay.settings, complaints=tuple(complaints))
        if result.passed:
            return result
        ends = zip(self._proxies, said, strict=True)
        counted = [f"{proxy.label} counts {words}" for proxy, each in ends if (words := _faults(each))]
        return replace(result, complaints=(*complaints, *counted))

    def _finish(self, proxy: LabProcess) -> Event:
        """Request a proxy to end; return its final report."""
        self.overlay.supervisor.release(proxy)
        proxy.send(signal.SIGINT)
        return self.overlay.supervisor.wait_for(proxy, "done", ENDING_S)

    def _start_proxy(self, at: Attachment, graph: Graph, side: Side, *, heard: bool = True) -> LabProcess:
        carried = {side: carried_in(self._options.encoding)}
        config = self.overlay.credentials.proxy(at, carried, ros=graph.to_yaml())
        return self.overlay.start_proxy(at.switch, config, graph.environment(self._run.directory), heard=heard)

    def _start(self, at: Attachment, graph: Graph, role: str, argv: list[str]) -> LabProcess:
        return self.overlay.lab.start(at.switch, role, argv, graph.environment(self._run.directory))


def _require(versions: set[int]) -> None:
    """Refuse a missing ROS version, with one sentence."""
    if 1 in versions and not (Path(rospy_folder()) / "rosmaster").is_dir():
        raise LocalError("ROS 1 needs rosmaster, which is not installed here: run sudo scripts/setup_ros1.sh")
    missing = [name for name in _ROS2 if 2 in versions and importlib.util.find_spec(name) is None]
    if missing:
        raise LocalError(
            f"ROS 2 needs {', '.join(missing)}, which this Python does not have: run scripts/setup.sh --ros2, or source"
            " your ROS 2"
        )


def _faults(done: Event) -> str:
    """Return the faults that a proxy counted; empty: none."""
    return ", ".join(f"{count} {label}" for label, count in done.get("faults", {}).items() if count)
