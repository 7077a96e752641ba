"""Switch node (``gdp-switch``): the core of a switch on real devices."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gdp.config.config import SwitchConfig
from gdp.control.hello import NodeSettings
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import LocalError, StatementError
from gdp.host.single_instance import own_devices
from gdp.intervals import PACE_S, UPKEEP_S
from gdp.links.uplink import refuse_loopback
from gdp.links.veth import attach_pairs, switch_end
from gdp.management.control_socket import ControlHandlers
from gdp.nodes.audit import audit_folder
from gdp.nodes.data_plane import Chosen, choose_plane
from gdp.nodes.membership import fresh_settings, load_member
from gdp.nodes.node import Loop, Node, common_handlers, common_sources
from gdp.nodes.node_log import OnWait
from gdp.nodes.rights import confine_switch
from gdp.ports.plane import MAC_BYTES, Plane
from gdp.ports.rtnetlink import LinkMonitor
from gdp.runtime.runtime import DRAIN_MAX_S, Runtime, now
from gdp.state.control_status import link_status
from gdp.state.name_lookup import SwitchLookups
from gdp.state.node_state import SwitchState
from gdp.state.snapshot import switch_snapshot, topology_snapshot
from gdp.state.state_answers import answer_for_switch
from gdp.state.switch_tables import switch_rows, switch_tables
from gdp.state.topic_rows import rows_to_fields
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.telemetry.sources import Sources

if TYPE_CHECKING:  # a switch without tunnels loads nothing of them
    from gdp.links.links import TunnelLinks
    from gdp.links.relay_ports import RelayPorts
    from gdp.ports.tunnel.wireguard import WireGuardDevice

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
    identity, policy = member = load_member(config.identity, config.domain, Role.SWITCH)
    if not (config.ports or config.attach or config.links is not None or config.relay):
        raise LocalError("a switch needs at least one port: --iface, or ports, links or relay in the configuration")
    refuse_loopback(ifaces := [port.iface for port in config.ports])
    table = Table()
    with contextlib.ExitStack() as stack:
        node = Node("switch", member, config, stack, state_folder=config.state, audit=audit_folder(config.audit))
        switch = node.build_core(
            lambda identity, policy, settings: SwitchCore(identity, policy, table, settings),
            _settings(config),
            config.journal,
            unrepeatable="" if config.links is None else "calls about tunnels are not in its journal",
        )
        stack.enter_context(own_devices(ifaces))
        stack.enter_context(attach_pairs(config.attach, identity.name, _widest(ifaces)))
        wanted = [port.iface for port in config.ports if not port.optional]
        devices = [*wanted, *map(switch_end, config.attach)]
        underlays: tuple[WireGuardDevice, ...] = ()
        if config.links is not None:
            from gdp.links.tunnels import open_underlays

            underlays = stack.enter_context(open_underlays(config.links, identity))
        chosen = choose_plane(config.data_plane, devices, table, config.table_max)
        plane = chosen.plane
        stack.callback(plane.close)
        _add_ports(config, plane, switch)
        optional = {port.index for port in plane.ports.values() if port.ifname in ifaces and port.ifname not in wanted}
        runtime = Runtime(switch, plane, {port.iface: port.cost for port in config.ports})
        attachments = {port.index for port in plane.ports.values() if port.ifname not in ifaces}
        links = None
        if config.links is not None:
            from gdp.links.links import TunnelLinks

            links = TunnelLinks(
                config=config.links, identity=identity, policy=policy, switch=switch, runtime=runtime,
                underlays=underlays,
            )  # fmt: skip
        relay = _follow_relay(config, identity, switch, runtime, stack)
        state = SwitchState(identity, policy, plane, switch, now().mono_s)
        dynamic = [each for each in (links, relay) if each is not None]  # it waits for no neighbour there
        state.unwaited = lambda: attachments.union(_absent(plane, optional), *(each.ports for each in dynamic))
        node.drive(state, runtime, on_wait)
        runtime.every(UPKEEP_S, lambda _: _end_if_displaced(switch))

        def reload() -> None:
            node.reload()
            _revoke(switch, config.revocations)

        sources = common_sources(node.node_log, switch_sources(state, chosen, runtime))
        handlers = switch_handlers(state, chosen, sources, links, relay)
        handlers = replace(
            handlers,
            reload=reload,
            drain=lambda: runtime.drain(lambda: not len(switch.resolver.pending), DRAIN_MAX_S),
            is_drained=lambda: runtime.has_drained,
        )
        node.follow_clients(runtime, handlers, config.control_socket)
        _revoke(switch, config.revocations)
        if config.sandbox:
            confine_switch(config, chosen.name)
        if links is not None:
            runtime.every(PACE_S, links.handle_timer)
            stack.callback(lambda: links.close(now().mono_s))
        node.begin(runtime, config.metrics, sources)
        _report_start(identity, chosen, ready)
        runtime.run()


def _settings(config: SwitchConfig) -> NodeSettings:
    return replace(
        fresh_settings(config.lease_s),
        hello_s=config.hello_s,
        dead_s=config.dead_s,
        keepalive_ms=config.keepalive_or_default_ms,
        detect_multiplier=config.detect_multiplier,
    )


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


def _follow_relay(
    config: SwitchConfig, identity: Identity, switch: SwitchCore, runtime: Runtime, stack: contextlib.ExitStack
) -> RelayPorts | None:
    """Return the ports on devices of the switch's relay; None: the configuration has no relay."""
    if not config.relay:
        return None
    from gdp.links.relay_ports import RelayPorts

    named = frozenset(port.iface for port in config.ports)
    relay = RelayPorts(name=identity.name, switch=switch, runtime=runtime, excluded=named)
    stack.callback(relay.close)
    runtime.every(PACE_S, relay.handle_timer)
    return relay


def switch_handlers(
    state: SwitchState,
    chosen: Chosen,
    sources: Sources,
    links: TunnelLinks | None = None,
    relay: RelayPorts | None = None,
) -> ControlHandlers:
    """Return what clients of the control socket may ask of a switch.

    From now on the switch also answers diagnostic requests about its state, and tells the devices of its ports.
    """
    switch, plane, lookups = state.switch, state.plane, SwitchLookups(state.switch)
    tunnels = None if links is None else links.status
    answer_for_switch(state, tunnels)
    switch.diagnostic_answers.port_name = lambda index: plane.ports[index].ifname if index in plane.ports else ""

    def status() -> dict[str, object]:
        """Return the JSON fields that a switch adds."""
        more: dict[str, object] = {
            "data_plane": chosen.name,
            "ports": len(plane.ports),
            "neighbours": len(switch.hello_protocol.neighbours.all_up()),
            "link_quality": [link_status(row) for row in state.links],
        }
        if links is not None:
            more["links"] = links.status(now())
        if relay is not None:
            more["relay"] = relay.status()
        return more

    return replace(
        common_handlers(state, sources, switch_tables(state, tunnels), status, lambda: switch_snapshot(state)),
        topology=lambda: topology_snapshot(switch),
        topics=lambda: rows_to_fields(switch_rows(switch.attached.all(), chosen.entry_counts), now().mono_s),
        lookup=lambda name: lookups.lookup(name, now()),
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


def switch_sources(state: SwitchState, chosen: Chosen, loop: Loop) -> Sources:
    """Return the sources of metrics that a switch adds."""
    switch, plane = state.switch, state.plane
    two_paths = switch.multicast.path_counts()  # read in the node's own thread
    loop.every(UPKEEP_S, lambda _now: two_paths.update(switch.multicast.path_counts()))

    def frames() -> dict[str, int]:
        """Return the frame counts by direction."""
        now = plane.counters
        return {"in": now.frames_in, "out": now.frames_out, "forwarded": now.forwarded, "punted": now.punted}

    return Sources(
        frames=frames,
        table_entries=lambda: len(switch.table),
        entries=chosen.entry_counts,
        pending_frames=lambda: len(switch.resolver.pending),
        two_paths=lambda: two_paths,
        clashes=lambda: switch.hello_protocol.conflicts.clashes,
    )
