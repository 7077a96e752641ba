"""Figure 1 of FogROS G: a drone with ROS 2 and a cloud with ROS 1, both behind NATs, while the drone changes networks.

I/O; each machine runs its own proxy. ::

    drone   eth0 -- enterprise, then university: NATs ------+
                                                            +-- internet -- cloud-b: border, RIB, enrolment
    cloud-a ------- provider, NAT --------------------------+
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NamedTuple

from gdp.management.control_client import ask_node, find_control_socket
from gdp.state.control_protocol import Command
from internet_demo.scenario import Display, Event, Outcome, Pace, Stage
from lab.dds import udp_profile
from lab.internet.access import Access
from lab.internet.host import Host
from lab.internet.laboratory import Laboratory
from lab.process import LabProcess
from proxy.endpoints.ros1.install import rospy_folder
from ring.live_plan import MASTER_PORT, Graph

_PATIENCE_S: Final = 60.0
_DOMAIN: Final = 42
_ROW_BYTES: Final = 1_920  # of a picture
# The drone's address changes, so its nodes and its proxy meet on the loopback device.
_ON_LOOPBACK: Final = "<type>UDPv4</type><interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>"


class _Flow(NamedTuple):
    """A topic, the node of ``ring.nodes`` that publishes it under its ``original`` name, and its two machines."""

    topic: str
    node: str
    original: str
    start: Host
    end: Host


class _Stage(Stage):
    def _add_members(self) -> None:
        self.drone = self._laboratory.add_host("drone", self.add_site("enterprise", Access.PORT_RESTRICTED))
        self.cloud = self._laboratory.add_host("cloud-a", self.add_site("provider", Access.PORT_RESTRICTED))
        self.flows = (
            _Flow("/images", "camera", "/camera/image", self.drone, self.cloud),
            _Flow("/commands", "talker", "/chatter", self.cloud, self.drone),
        )
        self.graphs = {self.drone.label: Graph(2, _DOMAIN), self.cloud.label: Graph(1, 0)}
        for label, graph in self.graphs.items():
            variables = graph.environment(self._folder)
            self._laboratory.hosts[label].environment = dict(each.split("=", 1) for each in variables)
        profile = udp_profile(self._folder)
        profile.write_text(profile.read_text().replace("<type>UDPv4</type>", _ON_LOOPBACK))

    def admit(self, host: Host, token: str) -> None:
        """Let a machine join, and write its ROS into its proxy.yaml."""
        self.join(host, token)
        self.extend(host, "proxy", ros=self.graphs[host.label].to_yaml())

    def share(self, verb: str, flow: _Flow) -> None:
        """Expose or import a topic, each on its own side."""
        own, word, other = (flow.start, "--to", flow.end) if verb == "expose" else (flow.end, "--from", flow.start)
        self.type_at(own, verb, flow.topic, word, other.label)

    def drawing(self, when: str) -> list[str]:
        """Return the figure as text, with the path of now."""
        peers = {each.peer: each for each in self.links(self.drone)}
        found = peers.get(self.cloud.label) or peers.get(self.cloud_b.label)
        path = "no tunnel" if found is None else "direct" if found.is_direct else f"through {found.peer}"
        lines = [f"{when} the flight: the path is {path}"]
        for host, side in ((self.drone, "--+-- internet"), (self.cloud, "--+")):
            graph, site = self.graphs[host.label], host.site()
            nat = f"NAT of the {site.label} network, {site.address}"
            lines.append(f"  {host.label:7} ROS {graph.ros}  {host.lease().address:15} -- {nat:44} {side}")
        topics: Any = ask_node(
            find_control_socket(self.directory(self.drone) / "proxy"), Command.TOPICS, _PATIENCE_S
        ).result
        return [*lines, *(f"  {each['topic']:9} is {each['name']}" for each in topics["topics"])]


def _said(node: LabProcess, event: str, is_met: Callable[[dict[str, Any]], bool] = lambda _: True) -> dict[str, Any]:
    """Return the next event of this name for which ``is_met``, after a minute any. Raises ``FailedError``: none."""
    deadline_s = time.monotonic() + _PATIENCE_S
    while True:
        said: dict[str, Any] = node.read(deadline_s + _PATIENCE_S - time.monotonic())
        if said["event"] == event and (is_met(said) or time.monotonic() > deadline_s):
            return said


def run_figure1(laboratory: Laboratory, pace: Pace, display: Display) -> Outcome:
    """Play the figure, with ``pace.calm_s`` seconds of traffic before the flight and after it.

    Raises ``LocalError``: ROS is missing, a machine does not join, or a program does not start.
    """
    rospy_folder()  # raises
    outcome = Outcome()
    display.step("networks: an enterprise's and a university's NAT for the drone, a provider's NAT for the cloud")
    stage = _Stage(laboratory, pace.delay_ms)
    with ThreadPoolExecutor() as pool:
        university = stage.add_site("university", Access.PORT_RESTRICTED)
        token = stage.create_domain()
        stage.start(stage.cloud_b)
        list(pool.map(stage.admit, (stage.drone, stage.cloud), (token, stage.make_token())))
        _said(_launch(stage.cloud, "ring.nodes", "1", "master", str(MASTER_PORT)), "ready")
        stage.start(stage.drone, stage.cloud)
        nodes = {flow.topic: _start(stage, pace, flow) for flow in stage.flows}
        stage.wait_until_joined()
        for verb in ("expose", "import"):
            list(pool.map(stage.share, [verb] * len(stage.flows), stage.flows))
        outcome.typed = stage.typed
        for command in stage.typed:
            display.step(f"typed at {command}")
        for _, listener in nodes.values():
            _said(listener, "hears")
        outcome.drawing = stage.drawing("before")
        display.step("/images and /commands cross")
        for talker, _ in nodes.values():
            talker.send(signal.SIGUSR1)
        time.sleep(pace.calm_s)
        display.step("the drone flies from the enterprise network to the university network")
        stage.drone.attach(university)
        for topic, (talker, listener) in nodes.items():
            _count(outcome, topic, talker, listener)
        outcome.drawing += stage.drawing("after")
    return outcome


def _launch(host: Host, *words: str) -> LabProcess:
    return host.launch([sys.executable, "-m", *words], host.label)


def _start(stage: _Stage, pace: Pace, flow: _Flow) -> tuple[LabProcess, LabProcess]:
    """Start the ring's talker and listener of a flow; return them when they are ready."""
    count, rows = int(2 * pace.calm_s * pace.rate_hz), max(1, pace.image_bytes // _ROW_BYTES)
    nodes = []
    for host, role in ((flow.start, flow.node), (flow.end, f"listener:{flow.node}")):
        ros = stage.graphs[host.label].ros
        words = [str(ros), role, str(count), str(pace.rate_hz), str(rows), *(["--ros-args", "-r"] if ros == 2 else [])]
        nodes.append(_launch(host, "ring.nodes", *words, f"{flow.original}:={flow.topic}"))
    for each in nodes:
        _said(each, "ready")
    return nodes[0], nodes[1]


def _count(outcome: Outcome, topic: str, talker: LabProcess, listener: LabProcess) -> None:
    """Wait until all messages have arrived, or for a minute, and count those that did as they were."""
    sent = _said(talker, "done")["sent"]
    _said(listener, "progress", lambda said: said["topics"][0]["received"] >= len(sent))
    listener.send(signal.SIGINT)
    (report,) = _said(listener, "done")["topics"]
    heard = report["heard"]
    lost, pause_s = len(set(sent) - set(heard)), (report["silent_ms"] or 0.0) / 1e3
    outcome.images += len(sent)
    outcome.lost += lost
    outcome.doubled += len(heard) - len(set(heard))
    outcome.events.append(Event(f"{topic}: {len(sent)} sent, {len(heard)} arrived, {lost} lost", pause_s))
