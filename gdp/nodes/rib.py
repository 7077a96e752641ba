"""RIB node (``gdp-rib``): the core of a RIB on a real device, with its routes in memory or in a cluster.

I/O.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable

from gdp.client.attachment import attachment_waits
from gdp.client.rib_host import RibHost
from gdp.config.config import RibConfig
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.host.service_notifier import service_notifier
from gdp.host.single_instance import run_alone
from gdp.links.uplink import load_plane, open_uplink
from gdp.management.control_client import control_path
from gdp.management.control_socket import ControlHandlers
from gdp.names import Name
from gdp.nodes.audit import audit_folder, keep_audit
from gdp.nodes.credentials import Credentials
from gdp.nodes.decision_log import log_decisions
from gdp.nodes.membership import fresh_bytes, incarnation, load_member, wall_clock_ms
from gdp.nodes.node_log import RECONCILE_PERIOD_S, NodeLog, OnWait
from gdp.nodes.port_rows import port_rows
from gdp.nodes.revocation_upkeep import load_revocations
from gdp.nodes.rib_upkeep import MemoryUpkeep, Upkeep
from gdp.nodes.rights import confine_rib
from gdp.ports.plane import Plane
from gdp.rib.core import RibCore, RibSettings
from gdp.runtime.runtime import DRAIN_MAX_S, Runtime, now
from gdp.state.control_status import node_status
from gdp.state.diagnostic_control import DiagnosticCommands
from gdp.state.link_rows import LinkRows
from gdp.state.member_tables import rib_tables
from gdp.state.name_lookup import rib_lookup
from gdp.state.snapshot import node_snapshot, rib_snapshot
from gdp.state.state_answers import answer_for_rib
from gdp.stores.audit_log import AuditLog
from gdp.telemetry.sources import Sources, count_list
from gdp.trust.domain import Policy

__all__ = ["run_rib"]

log = logging.getLogger(__name__)


def run_rib(config: RibConfig, ready: Callable[[Name], None], on_wait: OnWait | None = None) -> None:
    """Run a RIB until a signal or a drain ends it.

    Args:
        ready: called once with the RIB's name, when it has found its switch.
        on_wait: called with reason and text when the RIB reports what it waits for.

    Raises:
        LocalError: keys or the device differ from the configuration, or this RIB already runs.
    """
    identity, policy = load_member(config.identity, config.domain, Role.RIB)
    quotas = config.quotas
    settings = RibSettings(
        upper=config.upper,
        peers=config.peers,
        allow_unowned=config.allow_unowned,
        names_per_sender=quotas.names_per_sender,
        watches=quotas.watches,
        lease_max_s=quotas.lease_max_s,
    )
    attachment = NodeSettings(
        incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=fresh_bytes, lease_s=config.lease_s
    )
    with contextlib.ExitStack() as stack:
        stack.enter_context(run_alone("RIB", identity.name))
        notifier = stack.enter_context(service_notifier())
        folder = audit_folder(config.audit)
        if config.sandbox:
            if folder is not None:
                AuditLog(folder)  # makes the folder
            load_plane(config.data_plane)
            confine_rib(config)  # before the thread of the store starts; the device can still be opened
        revocations = load_revocations(config.state, policy.revoked, stack)
        upkeep = _upkeep(config, policy)
        stack.callback(upkeep.close)
        rib = RibCore(identity, policy, upkeep.store, settings)
        host = RibHost(identity, policy, rib, attachment)
        upkeep.begin(rib, now())
        plane = stack.enter_context(open_uplink(config.iface, config.data_plane))
        runtime = Runtime(host, plane)
        runtime.every(upkeep.every_s, upkeep.work)
        revocations.start(runtime)
        keep_audit(config.audit, policy.audit, host.drops, runtime, stack)
        node_log = NodeLog(
            host.attachment.hello_protocol,
            policy,
            plane,
            rib.boundary,
            lambda now_s: [*attachment_waits(host.attachment, now_s), *rib.waits(now_s)],
            on_wait=on_wait,
        )
        runtime.every(RECONCILE_PERIOD_S, node_log.log_changes)
        credentials = Credentials(config.identity, config.domain, identity, policy)
        runtime.every(RECONCILE_PERIOD_S, credentials.reload_changed)
        stack.enter_context(runtime.signals(lambda: credentials.reload_changed(now())))
        notifier.follow(runtime.every)
        sources, begun_s = _sources(host, plane, node_log, runtime), now().mono_s
        log_decisions(runtime, plane.ports, sources.drops)
        answer_for_rib(host, policy, node_log.wait_facts)
        commands = DiagnosticCommands(
            diagnostics=host.diagnostics,
            policy=policy,
            own_switch=lambda: host.attachment.switch.name if host.attachment.switch is not None else None,
            now=now,
            tables=rib_tables(host, upkeep.store, plane, policy, sources.drops),
            role="RIB",
        )
        handlers = ControlHandlers(
            reload=lambda: credentials.reload_changed(now()),
            status=lambda: node_status(
                identity, sources, uptime_s=now().mono_s - begun_s, attached=host.attachment.switch is not None
            ),
            snapshot=lambda: {
                **node_snapshot(identity, sources, uptime_s=now().mono_s - begun_s),
                **rib_snapshot(rib, None if host.attachment.switch is None else host.attachment.switch.name),
            },
            drain=lambda: runtime.drain(lambda: True, DRAIN_MAX_S),
            is_drained=lambda: runtime.has_drained,
            lookup=lambda name: rib_lookup(rib, identity.name, name, now()),
            ask=commands.ask,
            show=commands.show,
        )
        stack.enter_context(runtime.control(config.control_socket or control_path(identity.name), handlers))
        for source in upkeep.sources():
            runtime.watch(source, lambda: upkeep.work(now()))
        if config.metrics is not None:
            from gdp.telemetry.metrics import Metrics

            metrics = Metrics(sources)
            metrics.serve(config.metrics.port)
            stack.callback(metrics.close)
        log.info("rib up name=%s iface=%s plane=%s", identity.name.short, config.iface, config.data_plane)
        if runtime.run(lambda: host.attachment.switch is not None):
            ready(identity.name)
        runtime.run()


def _upkeep(config: RibConfig, policy: Policy) -> Upkeep:
    if config.store == "memory":
        return MemoryUpkeep(config.snapshot)
    from gdp.nodes.rib_cluster import ClusterUpkeep  # the client library is an optional extra

    return ClusterUpkeep(config.store.cluster.address(), policy, allow_unowned=config.allow_unowned)


def _sources(host: RibHost, plane: Plane, node_log: NodeLog, runtime: Runtime) -> Sources:
    counters, rib = plane.counters, host.rib
    links = LinkRows(host.attachment.hello_protocol, plane.ports)
    runtime.every(RECONCILE_PERIOD_S, links.refresh)
    return Sources(
        frames=lambda: {"in": counters.frames_in, "out": counters.frames_out, "punted": counters.punted},
        drops=[lambda: counters.drops, lambda: count_list(host.drops())],
        table_entries=lambda: rib.names,
        rib_answers=lambda: {
            "found": rib.answers,
            "negative": rib.negative_answers,
            "unknown": rib.unknown_answers,
            "accepted": rib.accepted,
        },
        rib_refusals=lambda: {reason.label: count for reason, count in list(rib.refusals.items())},
        waiting=node_log.metrics,
        links=lambda: links.rows,
        ports=lambda: port_rows(plane.ports),
        health=node_log.health,
        clashes=lambda: rib.identities.clashes + host.attachment.hello_protocol.conflicts.clashes,
    )
