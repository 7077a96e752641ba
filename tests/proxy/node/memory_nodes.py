"""Nodes of a small network in memory, and what each command reads of them, as JSON.

::

    s1/robot: graph, proxy - s1 - s2 - s3 - s3/server: graph, proxy
                                  |
                                 RIB

Keys follow from a seed and the clock is virtual, so all values repeat. Names are replaced by labels.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast
from unittest import mock

from cryptography.hazmat.primitives.asymmetric import ec

from gdp.client.attachment import attachment_waits
from gdp.crypto.keys import SoftwareKey
from gdp.dashboard.core.readings import Reading
from gdp.dashboard.core.scene import Scene
from gdp.management.control_socket import ControlHandlers
from gdp.names import Name
from gdp.nodes import rib as rib_node
from gdp.nodes import switch as switch_node
from gdp.nodes.data_plane import Chosen
from gdp.nodes.node_log import NodeLog
from gdp.ports.plane import Counters, Port
from gdp.runtime import runtime as runtime_module
from gdp.sansio import Timestamps
from gdp.state.control_status import node_status
from gdp.state.diagnostic_control import DiagnosticCommands
from gdp.state.link_rows import LinkRows
from gdp.state.member_tables import rib_tables
from gdp.state.name_lookup import rib_lookup
from gdp.state.snapshot import node_snapshot, rib_snapshot
from gdp.state.state_answers import answer_for_rib
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import Sources
from gdp.trust.domain import Policy
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.bridge.bridge import Bridge
from proxy.bridge.core.flow_fields import flow_fields
from proxy.bridge.core.topic_rows import flow_rows
from proxy.bridge.topic_counts import topic_counts
from proxy.node import bridge_node
from proxy.node import node as proxy_node
from proxy.node.node import ProxyNode
from proxy.node.state_answer import answer_for_proxy
from tests.insiders.oracle import signing_oracle
from tests.proxy import rule_files
from tests.proxy.bridge import sites as sites_module
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import Ear, Machine, Sites, named

__all__ = ["outputs"]

ROBOT, SERVER = "s1/robot", "s3/server"
_CHATTER, _SWITCH = f"name: /chatter, type: {STRING}", f"kind: service, name: /switch, type: {SET_BOOL}"
_UNDELEGATED, _BEST_EFFORT = f"name: /secret, type: {STRING}", f"name: /camera, type: {STRING}, reliable: false"
_HELD = (named("/chatter"), named("/camera"), named("/switch", SET_BOOL, "service"))
_LINE: Final = Topology(
    (Link("s1", "s2"), Link("s2", "s3")),
    (DomainPlan("line", ("s1", "s2", "s3")),),
    (Attachment("s2", "rib", "rib"),),
)
_MEMBER_TABLES: Final = ("neighbors", "links", "names", "peers", "drops")
_SWITCH_TABLES: Final = (*_MEMBER_TABLES, "routes", "trees", "tunnels")


class MemoryPlane:
    """Plane of a simulated node: its ports, and counts that tests set."""

    def __init__(self, ports: Mapping[int, Port]) -> None:
        self.ports = ports
        self.counters = Counters(frames_in=120, frames_out=110, forwarded=90, punted=30)
        self.counters.drops[3] = 2


class MemoryRuntime:
    """Runtime that keeps periodic calls, for ``tick``."""

    def __init__(self) -> None:
        self.calls: list[Callable[[Timestamps], None]] = []
        self.has_drained = False

    def every(self, period_s: float, call: Callable[[Timestamps], None]) -> None:
        """Keep a periodic call."""
        del period_s
        self.calls.append(call)

    def tick(self, now: Timestamps) -> None:
        """Make each periodic call."""
        for call in self.calls:
            call(now)


def outputs(folder: Path) -> dict[str, object]:
    """Return by node and command what clients read, with names replaced by labels."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(signing_oracle())
        owner = SoftwareKey.of(ec.derive_private_key(4_711, ec.SECP256R1()))
        for module in (rule_files, sites_module):
            stack.enter_context(mock.patch.object(module, "OWNER", owner))
        network = _Network(folder, stack)
        return network.labelled(network.read())


class _Network:
    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self._stack = stack
        self.sites = sites = Sites(folder, topology=_LINE)
        clock = SimpleNamespace(monotonic=lambda: sites.now_s, time=lambda: sites.world.network.now.unix_s)
        for module in (runtime_module, proxy_node, bridge_node):
            if hasattr(module, "time"):
                stack.enter_context(mock.patch.object(module, "time", clock))
        self.robot = sites.add(ROBOT, expose=[_CHATTER, _SWITCH, _BEST_EFFORT])
        self.server = sites.add(SERVER, imports=[_CHATTER, _SWITCH, _BEST_EFFORT, _UNDELEGATED], holds=_HELD)
        self.runtimes: dict[str, MemoryRuntime] = {}
        self.handlers: dict[str, ControlHandlers] = {}
        self.sources: dict[str, Sources] = {}
        self._run()
        for label in sites.world.switches:
            self._add_switch(label)
        self._add_rib("line")
        for machine in (self.robot, self.server):
            self._add_proxy(machine)
        sites.run(1.5)

    def _run(self) -> None:
        """Let a topic, a service and a best-effort topic flow."""
        sites = self.sites
        ear, camera_ear = Ear(self.server.graph, "/chatter"), Ear(self.server.graph, "/camera")
        server, client = LocalServer(self.robot.graph, answer=lambda _: switched("yes")), Client(self.server.graph)
        talker = self.robot.graph.publish("/talker", "/chatter", STRING)
        camera = self.robot.graph.publish("/camera_node", "/camera", STRING)
        assert sites.run(5, client.sees_server)
        sites.every(0.1, 50, lambda number: talker.publish(string(f"message {number}")))
        sites.every(0.1, 50, lambda number: camera.publish(string(f"image {number}")))
        client.call(switch(on=True))
        assert sites.run(10, lambda: len(ear.heard) > 40 and len(camera_ear.heard) > 40 and server.asked == 1)
        sites.run(1)

    def read(self) -> dict[str, object]:
        """Return what each command reads of each node."""
        world = self.sites.world
        now = world.network.now
        found: dict[str, object] = {}
        topic = self.robot.stream.topic if len(self.robot.member.publishers()) == 1 else self._topic()
        for label, handlers in self.handlers.items():
            self.runtimes[label].tick(now)
            shown: dict[str, object] = {"status": handlers.status(), "snapshot": handlers.snapshot()}
            for what in _SWITCH_TABLES if label in world.switches else _MEMBER_TABLES:
                with contextlib.suppress(Exception):
                    shown[f"show {what}"] = handlers.show({"what": what})
            if handlers.topics is not None:
                shown["topics"] = handlers.topics()
            if label in world.switches:
                shown["topology"] = handlers.topology()
            if handlers.lookup is not None:
                shown["lookup"] = handlers.lookup(topic)
            lines = Metrics(self.sources[label]).text().splitlines()
            shown["metrics"] = [line for line in lines if "gdp_latency" not in line]  # by the clock of the host
            found[label] = shown
        found["dashboard"] = self._scene()
        for label, identity in world.identities.items():
            if label not in world.switches or label in self.handlers:
                found[f"state {label}"] = self._ask(identity.name, topic)
        return found

    def labelled(self, found: object) -> dict[str, object]:
        """Return the outputs with the names of nodes, topics and the domain replaced by labels."""
        world = self.sites.world
        names = {identity.name: label for label, identity in world.identities.items()}
        names |= {each.root.domain: label for label, each in world.authorities.items()}
        names |= {spec.name: spec.local for machine in self.sites.machines for spec, _ in machine.bridge.flows}
        names |= {spec.name: spec.local for machine in self.sites.machines for spec in machine.bridge.undelegated}
        text = json.dumps(found, ensure_ascii=False)
        for name, label in names.items():
            digits = name.to_text()
            text = text.replace(digits, f"<{label}>").replace(digits[:16], f"<{label}:16>")
            text = text.replace(name.short, f"<{label}:short>")
        shown: dict[str, object] = json.loads(text)
        return shown

    def _topic(self) -> Name:
        return next(spec.name for spec, _ in self.robot.bridge.flows if spec.local == "/chatter")

    def _scene(self) -> dict[str, object]:
        scene = Scene()
        for second in range(2):
            rows = [
                Reading(json.loads(json.dumps(each.snapshot())), json.loads(json.dumps(each.topology())))
                for each in self.handlers.values()
            ]
            scene.update(rows, float(second), float(second))
        return {"structure": scene.structure(), "figures": scene.figures(0), "name": scene.name_detail("x")}

    def _ask(self, target: Name, topic: Name) -> Mapping[str, object]:
        """Return the reply of a node to ``state``, asked over the network in memory."""
        replies: list[Mapping[str, object]] = []
        asker = self.server
        for _ in range(8):
            handlers = self.handlers[asker.label]
            arguments = {"ask": "state", "id": 1, "target": target.to_text(), "name": topic.to_text(),
                         "body": {"q": "/chatter"}, "reply_bytes": 2_500}  # fmt: skip
            handlers.ask(arguments, lambda response: replies.append(response.result))
            self.sites.world.network.send_pending(asker.label)
            self.sites.run(1.0, lambda: bool(replies))
            if replies and replies[-1].get("state") == "answered":
                break
        return dict(replies[-1])

    def _plane(self, node: str) -> Any:
        ports = self.sites.world.network._nodes[node].ports
        return MemoryPlane(
            {
                index: Port(index, f"to-{far.node.replace('/', '-')}", own.mac, link.mtu, up=True)
                for index, (link, own, far) in ports.items()
            }
        )

    def _add_switch(self, label: str) -> None:
        world = self.sites.world
        switch, identity, plane = world.switches[label], world.identities[label], self._plane(label)
        policy, runtime, chosen = switch._policy, cast(Any, MemoryRuntime()), Chosen(plane, "raw", "no kernel here")
        node_log = NodeLog(
            switch.hello_protocol, policy, plane, switch.boundary, lambda now_s: switch.waits(set(), now_s),
            rib=lambda: switch.rib,
        )  # fmt: skip
        runtime.every(0.5, node_log.log_changes)
        sources = switch_node._sources(switch, chosen, node_log, runtime)
        commands = switch_node._diagnostic_commands(identity, policy, switch, plane, sources, None, node_log)
        self.handlers[label] = switch_node._control_handlers(
            identity, switch, chosen, runtime, lambda: None, sources, None, None, commands, self._stack
        )
        self.runtimes[label], self.sources[label] = runtime, sources

    def _add_rib(self, label: str) -> None:
        world = self.sites.world
        host, identity = world.ribs[label], world.identities[f"rib:{label}"]
        plane, runtime = self._plane(world.rib_node(label)), cast(Any, MemoryRuntime())
        policy: Policy = host.rib._policy
        rib, now = host.rib, runtime_module.now
        node_log = NodeLog(
            host.attachment.hello_protocol, policy, plane, rib.boundary,
            lambda now_s: [*attachment_waits(host.attachment, now_s), *rib.waits(now_s)],
        )  # fmt: skip
        runtime.every(0.5, node_log.log_changes)
        sources, begun_s = rib_node._sources(host, plane, node_log, runtime), now().mono_s
        answer_for_rib(host, policy, node_log.wait_facts)
        commands = DiagnosticCommands(
            diagnostics=host.diagnostics,
            policy=policy,
            own_switch=lambda: host.attachment.switch.name if host.attachment.switch is not None else None,
            now=now,
            tables=rib_tables(host, rib._store, plane, policy, sources.drops),
            role="RIB",
        )
        self.handlers[f"rib:{label}"] = ControlHandlers(
            reload=lambda: None,
            status=lambda: node_status(
                identity, sources, uptime_s=now().mono_s - begun_s, attached=host.attachment.switch is not None
            ),
            snapshot=lambda: {
                **node_snapshot(identity, sources, uptime_s=now().mono_s - begun_s),
                **rib_snapshot(rib, None if host.attachment.switch is None else host.attachment.switch.name),
            },
            drain=lambda: None,
            lookup=lambda name: rib_lookup(rib, identity.name, name, now()),
            ask=commands.ask,
            show=commands.show,
        )
        self.runtimes[f"rib:{label}"], self.sources[f"rib:{label}"] = runtime, sources

    def _add_proxy(self, machine: Machine) -> None:
        world = self.sites.world
        member, plane, runtime = machine.member, self._plane(machine.label), cast(Any, MemoryRuntime())
        identity, policy, bridge = world.identities[machine.label], member.attachment._policy, machine.bridge
        hello_protocol = member.attachment.hello_protocol
        node_log = NodeLog(
            hello_protocol, policy, plane, member.boundary, lambda now_s: attachment_waits(member.attachment, now_s),
            conflict=lambda: member.attachment.conflict_at, local_name=lambda name: name.short,
        )  # fmt: skip
        links = LinkRows(hello_protocol, plane.ports)
        runtime.every(0.5, node_log.log_changes)
        runtime.every(0.5, links.refresh)
        node = ProxyNode(
            identity=identity, policy=policy, member=member, runtime=runtime, plane=plane, node_log=node_log,
            credentials=cast(Any, None), links=links, local_name=lambda name: name.short,
        )  # fmt: skip
        node.begun_s = self.sites.now_s
        node.traffic, node.faults = machine.context.traffic, machine.context.faults
        answer_for_proxy(bridge, machine.context, identity, policy, node_log.wait_facts, (0,))
        _follow(node, bridge)
        self.handlers[machine.label] = node.control_handlers()
        self.runtimes[machine.label], self.sources[machine.label] = runtime, node.sources()


def _follow(node: ProxyNode, bridge: Bridge) -> None:
    node.topic_counts = lambda: topic_counts(bridge.flows, has_names=True)
    node.best_effort = lambda: bridge.best_effort
    node.topics = lambda: flow_rows(bridge.flows, bridge.held, node.member)
    local_name = node.local_name
    node.local_name = lambda name: bridge_node._local_names(bridge).get(name) or local_name(name)
    node.flows = lambda: [flow_fields(*each) for each in bridge.flows]
    node.undelegated = lambda: [bridge_node._described(each) for each in bridge.undelegated]
    node.qos = lambda: [bridge_node._qos_fields(*each) for each in bridge.offered_qos]
    node.liveliness = lambda: [each.to_fields() for each in bridge.liveliness(runtime_module.now().mono_s)]
    node.unready = lambda: [{"local": local, "reason": reason} for local, reason in bridge.unready]
    node.denied = lambda: [
        {"side": "expose" if each.is_exposed else "import", "local": each.local, "pattern": each.pattern}
        for each in bridge.denied
    ]
