"""Proxy node: a participant of the overlay on one device, with the names that its configuration makes global.

I/O.
"""

from __future__ import annotations

import contextlib
import json
import logging
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Final

from gdp.client.attachment import attachment_waits
from gdp.client.participant import Participant, Topic
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import GdpError, LocalError
from gdp.host.service_notifier import service_notifier
from gdp.host.single_instance import run_alone
from gdp.links.uplink import open_uplink
from gdp.management.control_client import control_path
from gdp.management.control_socket import ControlHandlers
from gdp.message.loss import by_label
from gdp.names import Name
from gdp.nodes.credentials import Credentials, watched_folders
from gdp.nodes.decision_log import log_decisions
from gdp.nodes.delegation_store import DelegationStore, EpochTimer
from gdp.nodes.membership import fresh_bytes, incarnation, load_member, wall_clock_ms
from gdp.nodes.node_log import RECONCILE_PERIOD_S, NodeLog, OnWait
from gdp.nodes.port_rows import port_rows
from gdp.nodes.revocation_upkeep import load_revocations
from gdp.nodes.rights import confine_proxy
from gdp.ports.plane import Plane
from gdp.runtime.runtime import Runtime, now
from gdp.state.control_status import node_status
from gdp.state.diagnostic_control import DiagnosticCommands
from gdp.state.link_rows import LinkRows
from gdp.state.member_tables import participant_tables
from gdp.state.snapshot import member_snapshot, node_snapshot, short_id
from gdp.state.topic_rows import TopicRow, rows_to_fields
from gdp.telemetry.sources import Sources, TopicCounts, count_list
from gdp.trust.domain import Policy
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Faults
from proxy.bridge.sent_stats import SentStats
from proxy.config.config import ProxyConfig, Record

__all__ = ["ProxyNode", "open_topics", "run_node"]

log = logging.getLogger(__name__)

BEST_EFFORT_MAX: Final = 32  # topics in one status; each has less than 1 KiB
CALLED_MAX: Final = 256  # services in one status; each has less than 128 bytes
DENIED_MAX: Final = 50  # names in one status; each has less than 1.5 KiB
LIVELINESS_BYTES: Final = 96 << 10  # of a status, whose response has 256 KiB
QOS_MAX: Final = 256  # topics in one status; each has less than 200 bytes
UNDELEGATED_MAX: Final = 100  # flows in one status; each has less than 2 KiB of a response's 256
_GOODBYE_S: Final = 0.2  # time in which a leaving node still sends


@dataclass(slots=True, kw_only=True)
class ProxyNode:
    """The running node, for the command that drives it.

    Attributes:
        on_reload: reads the configuration again; raises ``GdpError`` where the old one stays. None: not supported.
        is_leaving: a SIGUSR1 or a drain arrived: answer what is under way, then end.
        has_drained: all that was under way was answered.
        topics: returns the topics that are carried now, for metrics.
        best_effort: returns what became of best-effort messages of exposed topics.
        undelegated: returns the flows that only lack a delegation, as fields of the status.
        qos: returns the QoS of exposed topics, as fields of the status.
        liveliness: returns who publishes, reads, serves and calls each name, as fields of the status.
        unready: returns local servers whose readiness probe does not pass, as fields of the status.
        denied: returns the local names that stay local because of ``deny``, as fields of the status.
        topics: returns the names that the command carries, with their counts.
        local_name: returns the ROS name of a name, or another form for people.
        flows: returns what the bridge carries, as fields of a snapshot.
        drains: whether the command checks ``is_leaving``; else a SIGUSR1 ends it at once.
    """

    identity: Identity
    policy: Policy
    member: Participant
    runtime: Runtime
    plane: Plane
    node_log: NodeLog
    credentials: Credentials
    links: LinkRows
    on_reload: Callable[[], None] | None = None
    best_effort: Callable[[], Sequence[SentStats]] = tuple
    topic_counts: Callable[[], Sequence[TopicCounts]] = tuple
    undelegated: Callable[[], Sequence[Mapping[str, str]]] = tuple
    qos: Callable[[], Sequence[Mapping[str, object]]] = tuple
    denied: Callable[[], Sequence[Mapping[str, str]]] = tuple
    unready: Callable[[], Sequence[Mapping[str, str]]] = tuple
    liveliness: Callable[[], Sequence[Mapping[str, object]]] = tuple
    topics: Callable[[], Iterable[TopicRow]] = tuple
    flows: Callable[[], Sequence[Mapping[str, object]]] = tuple
    is_leaving: bool = False
    drains: bool = False
    local_name: Callable[[Name], str] = Name.to_text
    has_drained: bool = False
    begun_s: float = field(default_factory=time.monotonic)
    traffic: Traffic = field(default_factory=Traffic)
    faults: Faults = field(default_factory=Faults)

    def reload(self) -> None:
        """Read the certificates, the configuration and the delegations again.

        Raises:
            GdpError: the old configuration stays in use; the text states why.
        """
        self.credentials.reload_changed(now())
        if self.on_reload is not None:
            self.on_reload()

    def reload_on_signal(self) -> None:
        """Reload after a SIGHUP, or when an epoch begins; an error is logged."""
        try:
            self.reload()
        except GdpError as error:
            log.error("configuration not reloaded, the old one stays in use reason=%s", error)

    def drain(self) -> None:
        """Answer what is under way, then end; a command that does not check ``is_leaving`` ends after this step."""
        self.is_leaving = True
        if not self.drains:
            self.has_drained = True  # received messages are written
            self.runtime.stop()

    def leave_soon(self, number: int, frame: FrameType | None) -> None:
        """Handle a SIGUSR1, which wakes the loop."""
        del number, frame
        self.drain()

    def control_handlers(self) -> ControlHandlers:
        """Return the handlers of the control socket."""
        sources = self.sources()

        def status() -> dict[str, object]:
            attached = self.member.attachment.is_attached
            missing = list(self.undelegated())[:UNDELEGATED_MAX]
            uptime_s = time.monotonic() - self.begun_s
            sent = [each.to_fields() for each in self.best_effort() if not each.is_whole][:BEST_EFFORT_MAX]
            denied = list(self.denied())
            names = self.liveliness()
            more = {
                "attached": attached,
                "calls": {
                    service: {"ended": ended, "total_ms": round(total_ms, 3)}
                    for service, (ended, total_ms) in list(self.traffic.answered.items())[:CALLED_MAX]
                },
                "undelegated": missing,
                "qos": list(self.qos())[:QOS_MAX],
                "names": len(names),
                "liveliness": _bounded(names),
                "unready": list(self.unready())[:UNDELEGATED_MAX],
                "denied": len(denied),
                "denied_names": denied[:DENIED_MAX],
                "best_effort_topics": sent,
            }
            return node_status(self.identity, sources, uptime_s=uptime_s, **more)

        def snapshot() -> dict[str, object]:
            """Return the fields of a live view."""
            fields = node_snapshot(self.identity, sources, uptime_s=time.monotonic() - self.begun_s)
            return fields | member_snapshot(self.member, self.flows())

        attachment = self.member.attachment
        commands = DiagnosticCommands(
            diagnostics=self.member.diagnostics,
            policy=self.policy,
            own_switch=lambda: None if attachment.switch is None else attachment.switch.name,
            now=now,
            tables=participant_tables(self.member, self.plane, self.policy, sources.drops, self._shown_name),
            role="proxy",
        )
        return ControlHandlers(
            reload=self.reload,
            status=status,
            snapshot=snapshot,
            drain=self.drain,
            is_drained=lambda: self.has_drained,
            topics=lambda: rows_to_fields(self.topics(), time.monotonic()),
            ask=commands.ask,
            show=commands.show,
        )

    def _shown_name(self, name: Name) -> str:
        return self.local_name(name)  # which the command replaces later

    def leave(self) -> None:
        """Leave the overlay, stopped or not, and run until the goodbye is sent."""
        self.member.leave()
        self.runtime.linger(time.monotonic() + _GOODBYE_S)

    def tell_refusals(self) -> None:
        """Log a warning for each advertisement that the overlay has rejected."""
        for each in self.member.attachment.advertisements:
            if each.refused is not None:
                name, right, reason = each.subject.name.short, each.right.value, each.refused.label
                log.warning("advertisement refused name=%s right=%s reason=%s", name, right, reason)

    def sources(self) -> Sources:
        """Return the sources of the metrics."""
        counters, member = self.plane.counters, self.member
        return Sources(
            frames=lambda: {"in": counters.frames_in, "out": counters.frames_out},
            drops=[lambda: counters.drops, lambda: count_list(member.drops())],
            messages=self.traffic.messages,
            message_bytes=self.traffic.message_bytes,
            repairs=lambda: {
                "sent": sum(publisher.protection.repairs for publisher in member.publishers()),
                "parity": sum(publisher.protection.parity.sent for publisher in member.publishers()),
                "recovered": sum(writer_proxy.recovery.recovered for writer_proxy in member.writer_proxies()),
            },
            lost=lambda: by_label(member.lost()),
            unconfirmed=lambda: by_label(member.unconfirmed()),
            faults=lambda: self.faults.counts,
            calls=self.traffic.calls,
            latency=lambda: self.traffic.latency,
            waiting=self.node_log.metrics,
            links=lambda: self.links.rows,
            ports=lambda: port_rows(self.plane.ports),
            topics=lambda: list(self.topic_counts()),
            health=self.node_log.health,
            clashes=lambda: member.attachment.clashes + member.attachment.hello_protocol.clashes,
        )


def _bounded(names: Sequence[Mapping[str, object]]) -> list[Mapping[str, object]]:
    """Return as many names as fit into one status."""
    left, fitting = LIVELINESS_BYTES, list[Mapping[str, object]]()
    for each in names:
        left -= len(json.dumps(each))
        if left < 0:
            break
        fitting.append(each)
    return fitting


@contextlib.contextmanager
def run_node(config: ProxyConfig, on_wait: OnWait | None = None) -> Iterator[ProxyNode]:
    """Open everything that a proxy needs; close it on leaving.

    Args:
        on_wait: called with reason and text when the proxy reports a wait.

    Raises:
        LocalError: keys, delegations or the device are not as configured, or this proxy already runs.
    """
    identity, policy = load_member(config.identity, config.domain, Role.PROXY)
    settings = NodeSettings(
        incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=fresh_bytes, lease_s=config.lease_s
    )
    member = Participant(identity, policy, settings)
    with contextlib.ExitStack() as stack:
        stack.enter_context(run_alone("proxy", identity.name))
        notifier = stack.enter_context(service_notifier())
        revocations = load_revocations(config.state, policy.revoked, stack)
        plane = stack.enter_context(open_uplink(config.iface, config.data_plane))
        runtime = Runtime(member, plane, spin_s=config.busy_poll_us / 1e6)
        node_log = NodeLog(
            member.attachment.hello_protocol,
            policy,
            plane,
            member.boundary,
            lambda now_s: attachment_waits(member.attachment, now_s),
            conflict=lambda: member.attachment.conflict_at,
            local_name=_local_names(config),
            on_wait=on_wait,
        )
        runtime.every(RECONCILE_PERIOD_S, node_log.log_changes)
        links = LinkRows(member.attachment.hello_protocol, plane.ports)
        runtime.every(RECONCILE_PERIOD_S, links.refresh)
        credentials = Credentials(config.identity, config.domain, identity, policy)
        runtime.every(RECONCILE_PERIOD_S, credentials.reload_changed)
        node = ProxyNode(
            identity=identity,
            policy=policy,
            member=member,
            runtime=runtime,
            plane=plane,
            node_log=node_log,
            credentials=credentials,
            links=links,
            local_name=_local_names(config),
        )
        configured = _configured_flows(config)
        node.flows = lambda: configured
        log_decisions(runtime, plane.ports, node.sources().drops)
        stack.callback(signal.signal, signal.SIGUSR1, signal.signal(signal.SIGUSR1, node.leave_soon))
        stack.enter_context(runtime.signals(node.reload_on_signal))
        runtime.every(RECONCILE_PERIOD_S, EpochTimer(node.reload_on_signal).handle_timer)
        notifier.follow(runtime.every)
        control = config.control_socket or control_path(identity.name)
        stack.enter_context(runtime.control(control, node.control_handlers()))
        if config.sandbox:
            again = watched_folders(config.identity, config.domain)
            files = (each.path if isinstance(each, Record) else each for each in (config.record, config.control_socket))
            kept = (*(None if each is None else each.parent for each in files), config.state)
            written = [folder for folder in kept if folder is not None]
            confine_proxy((*again, config.delegations), written, has_ros=bool(config.ros))
        revocations.start(runtime)
        if config.metrics is not None:
            from gdp.telemetry.metrics import Metrics

            metrics = Metrics(node.sources())
            metrics.serve(config.metrics.port)
            stack.callback(metrics.close)
        log.info("proxy up name=%s iface=%s", identity.name.short, config.iface)
        yield node


def _local_names(config: ProxyConfig) -> Callable[[Name], str]:
    """Return a function from overlay name to the local name of a rule with a type; a pattern's names are shortened."""
    rules = [rule for rule in (*config.expose, *config.imports) if rule.type_name and not rule.is_pattern]
    names = {rule.overlay_name: rule.name for rule in rules}
    return lambda name: names.get(name, name.short)


def _configured_flows(config: ProxyConfig) -> list[Mapping[str, object]]:
    """Return the rules of single names, as fields of a snapshot: what a node without a bridge carries."""
    return [
        {
            "name": short_id(rule.overlay_name),
            "local": rule.name,
            "type": rule.type_name or "",
            "kind": rule.kind,
            "is_exposed": rule in config.expose,
        }
        for rule in (*config.expose, *config.imports)
        if rule.type_name and not rule.is_pattern
    ]


def open_topics(config: ProxyConfig, held: DelegationStore) -> dict[Name, Topic]:
    """Return, for every rule, this node's rights to its name and the topic's secrets.

    Raises:
        LocalError: a rule without a type, or without a valid delegation.
    """
    topics: dict[Name, Topic] = {}
    for rule in [*config.expose, *config.imports]:
        if rule.is_denied:
            continue
        topic = held.get(rule.overlay_name)
        if topic is None:
            raise LocalError(
                f"{rule.name}: no delegation for {rule.overlay_name.to_text()} in {config.delegations};"
                " the owner makes one with 'gdp delegate --owner OWNER FILE' (FILE: this proxy.yaml)"
            )
        topics[rule.overlay_name] = topic
    return topics
