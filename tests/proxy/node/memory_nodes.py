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
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any, Final, cast
from unittest import mock

from cryptography.hazmat.primitives.asymmetric import ec

from gdp.crypto.keys import SoftwareKey
from gdp.management.control_socket import ControlHandlers
from gdp.names import Name
from gdp.nodes.data_plane import Chosen
from gdp.nodes.node import common_sources
from gdp.nodes.node_log import NodeLog
from gdp.nodes.rib import rib_handlers, rib_sources
from gdp.nodes.switch import switch_handlers, switch_sources
from gdp.runtime import runtime as runtime_module
from gdp.runtime.runtime import now
from gdp.sansio import Timestamps
from gdp.state.node_state import NodeState
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import Sources
from lab.topology import Attachment, DomainPlan, Link, Topology
from proxy.node.proxy_state import ProxyState, proxy_handlers, proxy_sources
from proxy.node.state_answer import answer_for_proxy
from tests.gdp.state.memory_states import plane_of, rib_state, switch_state
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


Projections = Mapping[str, Callable[[Iterable[ControlHandlers]], object]]


def outputs(folder: Path, projections: Projections = MappingProxyType({})) -> dict[str, object]:
    """Return by node and command what clients read, and further projections of all nodes; labels replace names."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(signing_oracle())
        owner = SoftwareKey.of(ec.derive_private_key(4_711, ec.SECP256R1()))
        for module in (rule_files, sites_module):
            stack.enter_context(mock.patch.object(module, "OWNER", owner))
        network = _Network(folder, stack)
        return network.labelled(network.read(projections))


class _Network:
    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.sites = sites = Sites(folder, topology=_LINE, look_s=0.002)
        clock = SimpleNamespace(monotonic=lambda: sites.now_s, time=lambda: sites.world.network.now.unix_s)
        stack.enter_context(mock.patch.object(runtime_module, "time", clock))
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

    def read(self, projections: Projections) -> dict[str, object]:
        """Return what each command reads of each node."""
        world = self.sites.world
        found: dict[str, object] = {}
        topic = self.robot.stream.topic if len(list(self.robot.member.publications)) == 1 else self._topic()
        for label, handlers in self.handlers.items():
            self.runtimes[label].tick(world.network.now)
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
        found |= {name: project(self.handlers.values()) for name, project in projections.items()}
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

    def _add_switch(self, label: str) -> None:
        state, chosen = switch_state(self.sites.world, label), Chosen(cast(Any, None), "raw")
        node_log, runtime = self._log(label, state)
        sources = common_sources(node_log, switch_sources(state, chosen, runtime))
        self.handlers[label], self.sources[label] = switch_handlers(state, chosen, sources), sources

    def _add_rib(self, label: str) -> None:
        state = rib_state(self.sites.world, label)
        node_log, _ = self._log(f"rib:{label}", state)
        sources = self.sources[f"rib:{label}"] = common_sources(node_log, rib_sources(state))
        self.handlers[f"rib:{label}"] = rib_handlers(state, sources, state.host.rib.state.store)

    def _add_proxy(self, machine: Machine) -> None:
        world, member = self.sites.world, machine.member
        identity, plane = world.identities[machine.label], plane_of(world, machine.label)
        state = ProxyState(identity, member.attachment._policy, plane, member, now().mono_s, {})
        state.context, state.bridge = machine.context, machine.bridge
        state.has_topic_names, state.ros_domains = True, (0,)
        node_log, _ = self._log(machine.label, state)
        answer_for_proxy(state, machine.bridge)
        sources = self.sources[machine.label] = common_sources(node_log, proxy_sources(state))
        self.handlers[machine.label] = proxy_handlers(state, sources)

    def _log(self, label: str, state: NodeState) -> tuple[NodeLog, Any]:
        node_log, runtime = NodeLog(state), MemoryRuntime()
        self.runtimes[label] = runtime
        runtime.every(0.5, node_log.log_changes)
        runtime.every(0.5, state.refresh)
        return node_log, cast(Any, runtime)
