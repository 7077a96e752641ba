"""Machines with a ROS graph, a proxy and its bridge each, on a simulated network of two domains, whose clock jumps.

A bridge is driven like in the proxy's loop: after events of its graph or the overlay, and when its own timer is due;
not more often.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from gdp.client.participant import Participant, Topic
from gdp.client.publisher import Publisher
from gdp.crypto.certificates import Role
from gdp.crypto.statements import parse
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.ros_names import Kind
from gdp.trust.owner import Owner
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.bridge.bridge import Bridge, BridgeRules
from proxy.bridge.context import BridgeContext
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Faults
from proxy.config.config import ProxyConfig, Rule
from proxy.endpoints.core.endpoint import proxy_node_name
from proxy.serial.channel import Qos, RosVersion
from tests.proxy.bridge import known
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph
from tests.proxy.rule_files import OWNER, furnish, proxy, rules

ROBOT: Final = "nuc1/robot"
SERVER: Final = "nuc5/server"
_ROW: Final = Topology(  # of the ring's switches those that have machines
    (Link("nuc1", "nuc3"), Link("nuc3", "nuc5")),
    (DomainPlan("school", ("nuc1",), upper="cloud"), DomainPlan("cloud", ("nuc3", "nuc5"))),
    (
        *(Attachment("nuc1", "rib", "rib"), Attachment("nuc3", "rib", "rib")),
        *(Attachment("nuc1", "proxy", "robot"), Attachment("nuc5", "proxy", "server")),
    ),
)
_GRAPHS: Final = {1: "{endpoint: ros1}", 2: "{endpoint: ros2, domain: 0}"}
_TICK_S: Final = 0.5  # of the proxy's loop
_RIGHTS: Final[dict[tuple[Kind, bool], Right]] = {
    ("topic", True): Right.PUBLISH,
    ("topic", False): Right.READ,
    ("service", True): Right.SERVE,
    ("service", False): Right.CALL,
    ("action", True): Right.SERVE,
    ("action", False): Right.CALL,
    ("node", True): Right.SERVE,
    ("node", False): Right.CALL,
}


class Granted(DelegationStore):
    """Delegations without a file."""

    def __init__(self, directory: Path, topics: Sequence[Topic]) -> None:
        self.directory = directory
        self.left_out = {}
        self._topics = {topic.name: topic for topic in topics}


@dataclass(slots=True, eq=False)
class Machine:
    """Machine with a graph and a proxy in it."""

    label: str
    member: Participant
    graph: FakeGraph
    endpoints: list[FakeEndpoint]
    context: BridgeContext
    bridge: Bridge
    tick_at_s: float = 0.0

    def is_due(self, now_s: float) -> bool:
        """Return whether the proxy's loop would wake up now."""
        has_news = bool(self.member._reception.messages) or any(endpoint._events for endpoint in self.endpoints)
        if has_news or now_s >= self.tick_at_s:
            return True
        due_s = self.bridge.get_timer()
        return due_s is not None and due_s <= now_s

    @property
    def endpoint(self) -> FakeEndpoint:
        """Return the endpoint in the machine's graph, the first of two."""
        return self.endpoints[0]

    @property
    def faults(self) -> dict[str, int]:
        """Return the faults that occurred."""
        return {label: count for label, count in self.context.faults.counts.items() if count}

    @property
    def carried(self) -> set[tuple[str, bool]]:
        """Return the local names that are carried, and whether they leave this machine."""
        return {(flow_spec.local, flow_spec.is_exposed) for flow_spec, _ in self.bridge.flows}

    @property
    def stream(self) -> Publisher:
        """Return the one publisher on the overlay."""
        (publisher,) = list(self.member.publications)
        return publisher

    def is_read(self, readers: int = 1) -> bool:
        """Return whether everything that it publishes has this many readers."""
        streams = list(self.member.publications)
        return bool(streams) and all(stream.readers == readers for stream in streams)


@dataclass(slots=True, eq=False)
class Ear:
    """Local subscriber, and its messages."""

    graph: FakeGraph
    topic: str
    type_name: str = known.STRING
    qos: Qos | None = None
    node: str = "/listener"
    heard: list[bytes] = field(default_factory=list)
    leave: Callable[[], None] = field(init=False)

    def __post_init__(self) -> None:
        self.leave = self.graph.subscribe(self.node, self.topic, self.type_name, self.heard.append, self.qos).close

    @property
    def texts(self) -> list[str]:
        """Return its messages, as texts."""
        return [known.text_of(raw, self.graph.ros) for raw in self.heard]


class Sites:
    """Network, and the machines at its edge.

    Args:
        folder: an empty one, for the files that rules name.
        topology: None: three switches in a row, the first of a domain of its own.
        look_s: after which a proxy with news wakes up.
        options: further ones of ``Simulation``.
    """

    def __init__(
        self, folder: Path, seed: int = 1, topology: Topology | None = None, look_s: float = 0.005, **options: Any
    ) -> None:
        self.world = Simulation(topology=topology or _ROW, seed=seed, keepalive_ms=500, **options)
        self.world.owner = Owner(OWNER, bytes(range(32)))
        self.machines: list[Machine] = []
        self._folder = folder
        self._look_s = look_s
        furnish(folder)
        assert self.world.run_until_attached()
        self._look()

    @property
    def now_s(self) -> float:
        """Return the virtual monotonic second."""
        return self.world.network.now.mono_s

    def add(
        self,
        label: str,
        *,
        expose: Sequence[str] = (),
        imports: Sequence[str] = (),
        graph: FakeGraph | None = None,
        ros: RosVersion = 2,
        more: FakeGraph | None = None,
        holds: Sequence[Metadata] | None = None,
    ) -> Machine:
        """Start a machine.

        Args:
            label: of its member, ``switch/device``.
            expose: rules, each as in ``proxy.yaml`` between its braces, without the owner.
            imports: likewise.
            graph: None: one of its own, where the usual types are known.
            ros: of that graph.
            more: a second graph, of the other ROS; rules then say which ``ros`` they are about.
            holds: what it has delegations for; None: for whatever its rules name in full.
        """
        if label not in self.world.members:
            self.world.add_member(label, label.partition("/")[0])
            assert self.world.run_until_attached()
        graph = graph or FakeGraph(ros, known.channels(ros), known.services(ros))
        graphs = [graph] if more is None else [graph, more]
        machine = self._start(label, graphs, self.config(expose, imports, *(each.ros for each in graphs)), holds)
        self.machines.append(machine)
        return machine

    def restart(self, machine: Machine) -> Machine:
        """Restart a machine's proxy without its memory; its graph stays."""
        self.kill(machine)
        self.world.restart_member(machine.label)
        assert self.world.run_until_attached()
        again = self._start(machine.label, [machine.graph], cast(ProxyConfig, machine.bridge.rules), None)
        self.machines.append(again)
        return again

    def leave(self, machine: Machine) -> None:
        """End a proxy like its command, with a goodbye."""
        machine.bridge.close()
        machine.member.leave()
        self.world.network.send_pending(machine.label)
        for endpoint in machine.endpoints:
            endpoint.shut_down()
        self.machines.remove(machine)

    def kill(self, machine: Machine) -> None:
        """End a proxy without a goodbye to the overlay."""
        for endpoint in machine.endpoints:
            endpoint.shut_down()
        self.machines.remove(machine)
        self.world.network.stop(machine.label)

    def name(self, label: str) -> Name:
        """Return the name of a member, whether it exists already or not."""
        domain = self.world.topology.domain_of(label.partition("/")[0]).label
        return self.world.identity(Role.PROXY, label, domain).name

    def config(self, expose: Sequence[str], imports: Sequence[str], *graphs: RosVersion) -> ProxyConfig:
        """Return a configuration, as read from a file; by default of one ROS 2 graph."""
        text = "ros: [" + ", ".join(_GRAPHS[ros] for ros in graphs or (2,)) + "]\n"
        text += f"expose:\n{rules(*expose)}" if expose else ""
        text += f"import:\n{rules(*imports)}" if imports else ""
        return proxy(self._folder, text)

    def held(self, member: Participant, config: BridgeRules, holds: Sequence[Metadata] | None = None) -> Granted:
        """Return delegations for the full names in the rules, or for ``holds``."""
        given: dict[Name, tuple[Metadata, set[Right]]] = {}
        for is_exposed, listed in ((True, config.expose), (False, config.imports)):
            for rule in listed:
                for metadata in _named(rule) if holds is None else _meant(rule, holds):
                    _, rights = given.setdefault(metadata.name(OWNER.public.compressed), (metadata, set()))
                    kind = cast(Kind, metadata["kind"])
                    rights.add(_RIGHTS[kind, is_exposed])
                    if rule.kind == "node" and kind == "topic":  # what a node hears crosses the other way
                        rights.add(_RIGHTS[kind, not is_exposed])
        return Granted(self._folder, [self._topic(member, *each) for each in given.values()])

    def reload(
        self,
        machine: Machine,
        *,
        expose: Sequence[str] = (),
        imports: Sequence[str] = (),
        holds: Sequence[Metadata] | None = None,
    ) -> None:
        """Give a proxy other rules, and reissue all delegations."""
        config = self.config(expose, imports, machine.graph.ros)
        machine.bridge.reload(config, self.held(machine.member, config, holds))
        machine.tick_at_s = 0.0

    def run(self, duration_s: float, until: Callable[[], bool] | None = None) -> bool:
        """Advance time; return whether ``until`` came true (True without one)."""
        return self.world.network.run(duration_s, until)

    def every(self, period_s: float, count: int, act: Callable[[int], None]) -> None:
        """Repeat an action from now on, with its number."""
        for number in range(count):
            self.world.network.call(number * period_s, partial(act, number))

    def _start(
        self, label: str, graphs: Sequence[FakeGraph], config: ProxyConfig, holds: Sequence[Metadata] | None
    ) -> Machine:
        member = self.world.members[label]
        endpoints = [FakeEndpoint(graph, f"/{proxy_node_name(member.name.to_text())}") for graph in graphs]
        context = BridgeContext(member, Traffic(), Faults())
        bridge = Bridge(context, config, endpoints, self.held(member, config, holds))
        return Machine(label, member, graphs[0], endpoints, context, bridge)

    def _topic(self, member: Participant, metadata: Metadata, rights: set[Right]) -> Topic:
        reported = {key: str(value) for key, value in metadata.items() if key != "name"}
        return self.world.topic(str(metadata["name"]), member, rights, **reported)

    def _look(self) -> None:
        now_s = self.now_s
        for machine in self.machines:
            if machine.is_due(now_s):
                machine.tick_at_s = now_s + _TICK_S
                machine.bridge.work(now_s)
                machine.member.flush(now_s)
                self.world.network.send_pending(machine.label)
        self.world.network.call(self._look_s, self._look)


def revocation_of(world: Simulation, topic: Topic) -> bytes:
    """Return the owner's revocation of what lets the node of a topic use it."""
    fingerprint = parse(topic.delegation.chain[-1]).fingerprint
    return world.owner.revoke(topic.delegation.subject, fingerprint, int(world.network.now.unix_s) + 100_000)


def named(name: str, type_name: str = known.STRING, kind: str = "topic") -> Metadata:
    """Return the subject of a delegation."""
    return Metadata({"kind": kind, "name": name, "type": type_name})


def _named(rule: Rule) -> list[Metadata]:
    return [] if rule.is_pattern or not rule.type_name else [rule.overlay_metadata]


def _meant(rule: Rule, holds: Sequence[Metadata]) -> list[Metadata]:
    return [each for each in holds if rule.kind == "node" or rule.local_of(each) is not None]
