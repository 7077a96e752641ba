"""Switch node (``gdp-switch``): the core of a switch on real devices.

I/O.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from gdp.config.config import SwitchConfig
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import LocalError, StatementError
from gdp.host.service_notifier import service_notifier
from gdp.host.single_instance import own_devices, run_alone
from gdp.links.links import LINKS_PERIOD_S, TunnelLinks
from gdp.links.relay_ports import RELAY_PERIOD_S, RelayPorts
from gdp.links.tunnels import open_underlays
from gdp.links.uplink import refuse_loopback
from gdp.links.veth import attach_pairs, switch_end
from gdp.management.control_client import control_path
from gdp.management.control_socket import ControlHandlers
from gdp.nodes.audit import keep_audit
from gdp.nodes.credentials import Credentials
from gdp.nodes.data_plane import Chosen, choose_plane
from gdp.nodes.decision_log import log_decisions
from gdp.nodes.membership import fresh_bytes, incarnation, load_member, wall_clock_ms
from gdp.nodes.metrics import serve_metrics
from gdp.nodes.node_log import RECONCILE_PERIOD_S, NodeLog, OnWait
from gdp.nodes.port_rows import port_rows
from gdp.nodes.revocation_upkeep import load_revocations
from gdp.nodes.rights import confine_switch
from gdp.ports.plane import MAC_BYTES, Plane
from gdp.ports.port_counters import PortCounters
from gdp.ports.rtnetlink import LinkMonitor
from gdp.ports.tunnel.wireguard import WireGuardDevice
from gdp.runtime.runtime import DRAIN_MAX_S, Runtime, now
from gdp.state.control_status import node_status
from gdp.state.diagnostic_control import DiagnosticCommands
from gdp.state.link_rows import LinkRows, link_status
from gdp.state.name_lookup import SwitchLookups
from gdp.state.snapshot import node_snapshot, switch_snapshot, topology_snapshot
from gdp.state.state_answers import answer_for_switch
from gdp.state.switch_tables import SwitchTables
from gdp.state.switch_topics import switch_rows
from gdp.state.topic_rows import rows_to_fields
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.telemetry.sources import Sources, count_list
from gdp.trust.domain import Policy

__all__ = ["run_switch"]

log = logging.getLogger(__name__)

_MTU_FALLBACK = 1_500


def run_switch(
    config: SwitchConfig, ready: Callable[[Identity, str, str], None], on_wait: OnWait | None = None
) -> None:
    """Run a switch until a signal or a drain ends it.

    Args:
        ready: called once after the start, with the identity, its data plane, and why that is not a better one.
        on_wait: called with reason and text when the switch reports what it waits for.

    Raises:
        LocalError: keys, devices or ports differ from the configuration, or this switch already runs. Nothing has
            been touched then.
    """
    identity, policy = load_member(config.identity, config.domain, Role.SWITCH)
    if not (config.ports or config.attach or config.links is not None or config.relay):
        raise LocalError("a switch needs at least one port: --iface, or ports, links or relay in the configuration")
    refuse_loopback(ifaces := [port.iface for port in config.ports])
    table = Table()
    settings = NodeSettings(
        incarnation=incarnation(),
        first_sequence=wall_clock_ms(),
        random_bytes=fresh_bytes,
        hello_s=config.hello_s,
        dead_s=config.dead_s,
        lease_s=config.lease_s,
        keepalive_ms=config.keepalive_or_default_ms,
        detect_multiplier=config.detect_multiplier,
    )
    switch = SwitchCore(identity, policy, table, settings)
    with contextlib.ExitStack() as stack:
        stack.enter_context(run_alone("switch", identity.name))
        notifier = stack.enter_context(service_notifier())
        revocations = load_revocations(config.state, policy.revoked, stack)
        stack.enter_context(own_devices(ifaces))
        stack.enter_context(attach_pairs(config.attach, identity.name, _widest(ifaces)))
        wanted = [port.iface for port in config.ports if not port.optional]
        devices = [*wanted, *map(switch_end, config.attach)]
        underlays = () if config.links is None else stack.enter_context(open_underlays(config.links, identity))
        chosen = choose_plane(config.data_plane, devices, table, config.table_max)
        plane = chosen.plane
        stack.callback(plane.close)
        _add_ports(config, plane, switch)
        optional = {port.index for port in plane.ports.values() if port.ifname in ifaces and port.ifname not in wanted}
        runtime = Runtime(switch, plane, {port.iface: port.cost for port in config.ports})
        attachments = {port.index for port in plane.ports.values() if port.ifname not in ifaces}
        links = _open_links(config, identity, policy, switch, runtime, underlays)
        relay = _follow_relay(config, identity, switch, runtime, stack)
        node_log = NodeLog(
            switch.hello_protocol,
            policy,
            plane,
            switch.boundary,
            lambda now_s: switch.waits(attachments | _absent(plane, optional) | _dynamic_ports(links, relay), now_s),
            rib=lambda: switch.rib,
            on_wait=on_wait,
        )
        runtime.every(RECONCILE_PERIOD_S, node_log.log_changes)
        runtime.every(RECONCILE_PERIOD_S, lambda _: _end_if_displaced(switch))
        credentials = Credentials(config.identity, config.domain, identity, policy)
        runtime.every(RECONCILE_PERIOD_S, credentials.reload_changed)

        def reload() -> None:
            credentials.reload_changed(now())
            _revoke(switch, config.revocations)

        stack.enter_context(runtime.signals(reload))
        notifier.follow(runtime.every)
        sources = _sources(switch, chosen, node_log, runtime)
        commands = _diagnostic_commands(identity, policy, switch, plane, sources, links, node_log)
        handlers = _control_handlers(identity, switch, chosen, runtime, reload, sources, links, relay, commands, stack)
        stack.enter_context(runtime.control(config.control_socket or control_path(identity.name), handlers))
        _revoke(switch, config.revocations)
        keep_audit(config.audit, policy.audit, switch.drops, runtime, stack)
        if config.sandbox:
            confine_switch(config, chosen.name)
        revocations.start(runtime)
        _start_links(links, runtime, stack)
        if config.metrics is not None:
            stack.callback(serve_metrics(sources, config.metrics.port))
        _report_start(identity, chosen, ready)
        runtime.run()


def _report_start(identity: Identity, chosen: Chosen, ready: Callable[[Identity, str, str], None]) -> None:
    said = identity.name.short, identity.role.value, chosen.name, len(chosen.plane.ports)
    log.info("switch up name=%s role=%s plane=%s ports=%d", *said)
    if chosen.reason:
        log.warning("not the best data plane plane=%s reason=%s", chosen.name, chosen.reason)
    ready(identity, chosen.name, chosen.reason)


def _add_ports(config: SwitchConfig, plane: Plane, switch: SwitchCore) -> None:
    """Add the optional ports, and set the keepalive timing of each configured one."""
    for port in config.ports:
        if port.optional:
            plane.add_port(port.iface, may_be_absent=True)
        index = next(each.index for each in plane.ports.values() if each.ifname == port.iface)
        switch.hello_protocol.set_timing(index, config.timing_of(port))


def _start_links(links: TunnelLinks | None, runtime: Runtime, stack: contextlib.ExitStack) -> None:
    if links is not None:
        runtime.every(LINKS_PERIOD_S, links.handle_timer)
        stack.callback(lambda: links.close(now().mono_s))


def _dynamic_ports(links: TunnelLinks | None, relay: RelayPorts | None) -> frozenset[int]:
    """Return the ports of tunnels and of the relay, for whose neighbours the switch does not wait."""
    return (frozenset() if links is None else links.ports) | (frozenset() if relay is None else relay.ports)


def _follow_relay(
    config: SwitchConfig, identity: Identity, switch: SwitchCore, runtime: Runtime, stack: contextlib.ExitStack
) -> RelayPorts | None:
    """Return the ports on devices of the switch's relay; None: the configuration has no relay."""
    if not config.relay:
        return None
    named = frozenset(port.iface for port in config.ports)
    relay = RelayPorts(name=identity.name, switch=switch, runtime=runtime, excluded=named)
    stack.callback(relay.close)
    runtime.every(RELAY_PERIOD_S, relay.handle_timer)
    return relay


def _open_links(
    config: SwitchConfig,
    identity: Identity,
    policy: Policy,
    switch: SwitchCore,
    runtime: Runtime,
    underlays: tuple[WireGuardDevice, ...],
) -> TunnelLinks | None:
    """Return the tunnels of a switch; None: none are configured."""
    if config.links is None:
        return None
    return TunnelLinks(
        config=config.links, identity=identity, policy=policy, switch=switch, runtime=runtime, underlays=underlays
    )


def _diagnostic_commands(
    identity: Identity,
    policy: Policy,
    switch: SwitchCore,
    plane: Plane,
    sources: Sources,
    links: TunnelLinks | None,
    node_log: NodeLog,
) -> DiagnosticCommands:
    """Return the handlers of diagnostic requests and tables.

    From now on the switch tells the devices of its ports, and what it waits for.
    """
    tunnels = None if links is None else links.status
    answer_for_switch(switch, policy, node_log.wait_facts, now().mono_s, tunnels)
    ports = plane.ports
    switch.diagnostic_answers.port_name = lambda index: ports[index].ifname if index in ports else ""
    return DiagnosticCommands(
        diagnostics=switch.diagnostics,
        policy=policy,
        own_switch=lambda: identity.name,
        now=now,
        tables=SwitchTables(switch, plane, policy, sources.drops, tunnels).sources,
        role="switch",
    )


def _control_handlers(
    identity: Identity,
    switch: SwitchCore,
    chosen: Chosen,
    runtime: Runtime,
    reload: Callable[[], None],
    sources: Sources,
    links: TunnelLinks | None,
    relay: RelayPorts | None,
    commands: DiagnosticCommands,
    stack: contextlib.ExitStack,
) -> ControlHandlers:
    begun_s, counters = now().mono_s, PortCounters()
    stack.callback(counters.close)
    lookups = SwitchLookups(switch)

    def status() -> dict[str, object]:
        """Return the JSON fields of this switch."""
        rows = sources.links() if sources.links is not None else ()
        more: dict[str, object] = {
            "data_plane": chosen.name,
            "ports": len(chosen.plane.ports),
            "neighbours": len(list(switch.hello_protocol.neighbours.all_up())),
            "link_quality": [link_status(row) for row in rows],
        }
        if links is not None:
            more["links"] = links.status(now())
        if relay is not None:
            more["relay"] = relay.status()
        return node_status(identity, sources, uptime_s=now().mono_s - begun_s, **more)

    def snapshot() -> dict[str, object]:
        """Return the fields of a live view."""
        rows = sources.links() if sources.links is not None else ()
        fields = node_snapshot(identity, sources, uptime_s=now().mono_s - begun_s)
        return fields | switch_snapshot(switch, rows, counters.read())

    return ControlHandlers(
        reload=reload,
        status=status,
        snapshot=snapshot,
        topology=lambda: topology_snapshot(switch),
        drain=lambda: runtime.drain(lambda: not switch.resolver.pending_frames, DRAIN_MAX_S),
        is_drained=lambda: runtime.has_drained,
        topics=lambda: rows_to_fields(switch_rows(switch.attached.all(), sources.entries), now().mono_s),
        lookup=lambda name: lookups.lookup(name, now()),
        ask=commands.ask,
        show=commands.show,
    )


def _absent(plane: Plane, ports: Collection[int]) -> set[int]:
    """Return the ports of this set whose device is missing; a node does not wait for an optional one."""
    return {index for index in ports if plane.ports[index].mac == bytes(MAC_BYTES)}


def _revoke(switch: SwitchCore, directory: Path | None) -> None:
    """Accept and flood the revocations in the operator's directory; known ones have no effect."""
    for path in sorted(directory.iterdir()) if directory is not None else ():
        try:
            switch.revoke(path.read_bytes(), now())
        except (OSError, StatementError) as error:
            log.error("revocation not taken file=%s reason=%s", path, error)


def _end_if_displaced(switch: SwitchCore) -> None:
    """Raise a ``LocalError`` if an older switch with this identity is alive."""
    if switch.is_displaced:
        raise LocalError("an older switch with this identity is alive; this one ends: give it keys of its own")


def _widest(ifaces: Sequence[str]) -> int:
    """Return the largest MTU of these devices; opening the port reports a missing one."""
    with contextlib.closing(LinkMonitor()) as links:
        mtus = [link.mtu for link in links.all() if link.ifname in ifaces]
    return max(mtus, default=_MTU_FALLBACK)


def _sources(switch: SwitchCore, chosen: Chosen, node_log: NodeLog, runtime: Runtime) -> Sources:
    plane = chosen.plane
    links = LinkRows(switch.hello_protocol, plane.ports)
    runtime.every(RECONCILE_PERIOD_S, links.refresh)
    two_paths = switch.multicast.path_counts()
    runtime.every(RECONCILE_PERIOD_S, lambda _now: two_paths.update(switch.multicast.path_counts()))

    def frames() -> dict[str, int]:
        """Return the frame counts by direction."""
        now = plane.counters
        return {"in": now.frames_in, "out": now.frames_out, "forwarded": now.forwarded, "punted": now.punted}

    sources = Sources(
        frames=frames,
        drops=[lambda: plane.counters.drops, lambda: count_list(switch.drops())],
        table_entries=lambda: len(switch.table),
        entries=chosen.entry_counts,
        pending_frames=lambda: switch.resolver.pending_frames,
        waiting=node_log.metrics,
        links=lambda: links.rows,
        ports=lambda: port_rows(plane.ports),
        health=node_log.health,
        two_paths=lambda: two_paths,
        clashes=lambda: switch.hello_protocol.conflicts.clashes,
    )
    log_decisions(runtime, plane.ports, sources.drops, switch.table)
    return sources
