"""State of a proxy, and what clients read of it: its attachment, and what its bridge carries.

I/O through the bridge, which it only reads.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from typing import Final

from gdp.client.participant import Participant
from gdp.config.offered_qos import OFFERED_DEPTH_MAX
from gdp.crypto.identity import Identity
from gdp.management.control_socket import ControlHandlers
from gdp.message.loss import by_label
from gdp.names import Name
from gdp.nodes.node import common_handlers
from gdp.ports.plane import Plane
from gdp.runtime.runtime import now
from gdp.sansio import Timestamps
from gdp.state.diagnostic_control import Row
from gdp.state.member_tables import participant_tables
from gdp.state.node_state import MemberState
from gdp.state.snapshot import member_snapshot
from gdp.state.topic_rows import rows_to_fields
from gdp.telemetry.sources import Sources, TopicCounts
from gdp.trust.domain import Policy
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Fault, Faults
from proxy.bridge.flow_rows import control_row, flow_fields, flow_rows, topic_counts
from proxy.serial.channel import Qos

BEST_EFFORT_MAX: Final = 32  # topics in one status; each has less than 1 KiB
CALLED_MAX: Final = 256  # services in one status; each has less than 128 bytes
DENIED_MAX: Final = 50  # names in one status; each has less than 1.5 KiB
LIVELINESS_BYTES: Final = 96 << 10  # of a status, whose response has 256 KiB
QOS_MAX: Final = 256  # topics in one status; each has less than 200 bytes
TRANSFORMS_S: Final = 0.1  # for which Nav2 extrapolates transforms (transform_tolerance)
UNDELEGATED_MAX: Final = 100  # flows in one status; each has less than 2 KiB of a response's 256


class ProxyState(MemberState):
    """State of a proxy.

    Args:
        rule_names: local names of the rules, by overlay name.

    Attributes:
        bridge: what carries names here; None until the command has made it.
        shows_held: names that the node may use, and does not, are listed, too.
        has_topic_names: metrics have local names.
        ros_domains: of its ROS 2 graphs.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        plane: Plane,
        member: Participant,
        begun_s: float,
        rule_names: Mapping[Name, str],
    ) -> None:
        super().__init__(identity, policy, plane, member, begun_s)
        self.context = BridgeContext(member, Traffic(), Faults())
        self.bridge: Bridge | None = None
        self.shows_held = True
        self.has_topic_names = False
        self.ros_domains: tuple[int, ...] = ()
        self._rule_names = rule_names
        self.local_name = self._local_name

    def refresh(self, now: Timestamps) -> None:
        """Read links and clocks again, and warn of each clock by which transforms would be extrapolated."""
        super().refresh(now)
        for member, clock in self.clocks:
            is_known = Fault.CLOCK.value in self.context.faults.of(member.label)
            if clock.least_s <= TRANSFORMS_S:
                self.context.faults.clear(member.label, Fault.CLOCK)
            elif not is_known:
                ahead = f"{abs(clock.offset_s):.3f} s {'ahead of' if clock.offset_s > 0 else 'behind'}"
                what = f"its clock is {ahead} that of {self.identity.label}, to {clock.bound_s:.3f} s"
                self.context.faults.report(member.label, Fault.CLOCK, f"{what}: transforms between both do not fit")

    def _local_name(self, name: Name) -> str:
        flows = () if self.bridge is None else self.bridge.flows
        carried = {flow_spec.name: flow_spec.local for flow_spec, _ in flows}
        return carried.get(name) or self._rule_names.get(name, name.short)


def proxy_sources(state: ProxyState) -> Sources:
    """Return the sources of metrics that a proxy adds."""
    counters, member, traffic = state.plane.counters, state.member, state.context.traffic

    def topics() -> list[TopicCounts]:
        return [] if state.bridge is None else topic_counts(state.bridge.flows, has_names=state.has_topic_names)

    return Sources(
        frames=lambda: {"in": counters.frames_in, "out": counters.frames_out},
        messages=traffic.messages,
        message_bytes=traffic.message_bytes,
        repairs=lambda: {
            "sent": sum(publisher.protection.repairs for publisher in list(member.publications)),
            "parity": sum(publisher.protection.parity.sent for publisher in list(member.publications)),
            "recovered": sum(writer_proxy.recovery.recovered for writer_proxy in member.subscriptions.writer_proxies()),
        },
        lost=lambda: by_label(member.subscriptions.lost()),
        unconfirmed=lambda: by_label(member.publications.unconfirmed()),
        faults=lambda: state.context.faults.counts,
        calls=traffic.calls,
        latency=lambda: traffic.latency,
        topics=topics,
        clashes=lambda: state.attachment.clashes + state.hello_protocol.conflicts.clashes,
    )


def proxy_handlers(state: ProxyState, sources: Sources) -> ControlHandlers:
    """Return what clients of the control socket may ask of a proxy."""

    def flows() -> list[dict[str, object]]:
        return [] if state.bridge is None else [flow_fields(*each) for each in state.bridge.flows]

    def topics() -> dict[str, object]:
        bridge = state.bridge
        held = bridge.held if bridge is not None and state.shows_held else ()
        rows = () if bridge is None else flow_rows(bridge.flows, held, state.member)
        return rows_to_fields(rows, now().mono_s)

    def control(now: Timestamps) -> list[Row]:
        specs = (
            []
            if state.bridge is None
            else [(spec, state.bridge.controlled(spec.name)) for spec, _ in state.bridge.flows]
        )
        rows = [
            {"local": spec.local, **control_row(*each, now.mono_s), "name": spec.name} for spec, each in specs if each
        ]
        return sorted(rows, key=lambda row: str(row["local"]))

    return replace(
        common_handlers(
            state,
            sources,
            {**participant_tables(state), "control": control},
            lambda: _attachment(state) | _carried(state.bridge),
            lambda: member_snapshot(state.member, flows()),
        ),
        topics=topics,
    )


def described(flow_spec: FlowSpec) -> dict[str, str]:
    """Return the fields by which an owner recognizes a flow; metadata are left out, because a salt may be in them."""
    return {
        "side": "expose" if flow_spec.is_exposed else "import",
        "kind": flow_spec.rule.kind,
        "local": flow_spec.local,
        "shared": flow_spec.rule.global_name_of(flow_spec.local),
        "type": flow_spec.type_name,
        "name": flow_spec.name.to_text(),
    }


def _attachment(state: ProxyState) -> dict[str, object]:
    calls = {
        service: {"ended": ended, "total_ms": round(total_ms, 3)}
        for service, (ended, total_ms) in islice(state.context.traffic.answered.items(), CALLED_MAX)
    }
    return {"attached": state.attachment.is_attached, "calls": calls}


def _carried(bridge: Bridge | None) -> dict[str, object]:
    """Return what a bridge carries, what it cannot carry and why, as fields of a status."""
    if bridge is None:
        return {}
    names = [each.to_fields() for each in bridge.liveliness(now().mono_s)]
    denied = [
        {"side": "expose" if each.is_exposed else "import", "local": each.local, "pattern": each.pattern}
        for each in bridge.denied
    ]
    unready = [{"local": local, "reason": reason} for local, reason in bridge.unready]
    return {
        "undelegated": [described(each) for each in bridge.undelegated[:UNDELEGATED_MAX]],
        "qos": [_qos_fields(*each) for each in bridge.offered_qos[:QOS_MAX]],
        "names": len(names),
        "liveliness": _bounded(names),
        "unready": unready[:UNDELEGATED_MAX],
        "denied": len(denied),
        "denied_names": denied[:DENIED_MAX],
        "best_effort_topics": [each.to_fields() for each in bridge.best_effort if not each.is_whole][:BEST_EFFORT_MAX],
    }


def _qos_fields(flow_spec: FlowSpec, profile: Qos) -> dict[str, object]:
    depth = min(max(profile.depth, 1), OFFERED_DEPTH_MAX)
    policies = {"reliability": profile.reliability, "durability": profile.durability, "depth": depth}
    return {"name": flow_spec.name.to_text(), **policies}


def _bounded(names: list[dict[str, object]]) -> list[dict[str, object]]:
    """Return as many names as fit into one status."""
    left, fitting = LIVELINESS_BYTES, list[dict[str, object]]()
    for each in names:
        left -= len(json.dumps(each))
        if left < 0:
            break
        fitting.append(each)
    return fitting
