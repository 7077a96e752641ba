"""RIB node (``gdp-rib``): the core of a RIB on a real device, with its routes in memory or in a cluster."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Protocol

from gdp.client.rib_host import RibHost
from gdp.config.config import ClusterConfig, RibConfig
from gdp.crypto.certificates import Role
from gdp.extras import Seam
from gdp.links.uplink import load_plane, open_uplink
from gdp.management.control_socket import ControlHandlers
from gdp.names import Name
from gdp.nodes.audit import audit_folder
from gdp.nodes.membership import fresh_settings, load_member
from gdp.nodes.node import Node, common_handlers, common_sources
from gdp.nodes.node_log import OnWait
from gdp.nodes.rib_upkeep import MemoryUpkeep, Upkeep
from gdp.nodes.rights import confine_rib
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import Store
from gdp.runtime.runtime import DRAIN_MAX_S, Runtime, now
from gdp.state.member_tables import rib_tables
from gdp.state.name_lookup import rib_lookup
from gdp.state.node_state import RibState
from gdp.state.snapshot import rib_snapshot
from gdp.state.state_answers import answer_for_rib
from gdp.telemetry.sources import Sources
from gdp.trust.domain import Policy

log = logging.getLogger(__name__)


class _OpenStore(Protocol):
    """Opens a store outside of the RIB's process, with its upkeep."""

    def __call__(self, cluster: ClusterConfig, policy: Policy, *, allow_unowned: bool) -> Upkeep: ...


_STORES: Final[Seam[_OpenStore]] = Seam("gdp.store")


def run_rib(config: RibConfig, ready: Callable[[Name], None], on_wait: OnWait | None = None) -> None:
    """Run a RIB until a signal or a drain ends it.

    Args:
        ready: called once with the RIB's name, when it has found its switch.
        on_wait: called with reason and text when the RIB reports what it waits for.

    Raises:
        LocalError: keys or the device differ from the configuration, or this RIB already runs.
    """
    identity, policy = member = load_member(config.identity, config.domain, Role.RIB)
    with contextlib.ExitStack() as stack:
        audit = audit_folder(config.audit)
        node = Node("RIB", member, config, stack, state_folder=config.state, audit=audit)
        make_plane = load_plane(config.data_plane, stack)
        if config.sandbox:
            confine_rib(config)  # before the thread of the store starts; the device can still be opened
        upkeep = _upkeep(config, policy)
        stack.callback(upkeep.close)
        host = node.build_core(
            lambda identity, policy, settings: RibHost(
                identity, policy, RibCore(identity, policy, upkeep.store, _settings(config)), settings
            ),
            fresh_settings(config.lease_s),
            config.journal,
            rib=_settings(config),
            unrepeatable="" if config.store == "memory" else "what its cluster answered is not in its journal",
        )
        upkeep.start(host.rib, now())
        plane = stack.enter_context(open_uplink(config.iface, make_plane))
        runtime = Runtime(host, plane)
        runtime.every(upkeep.every_s, upkeep.work, upkeep.has_work)
        state = RibState(identity, policy, plane, host, now().mono_s)
        node.drive(state, runtime, on_wait)
        sources = common_sources(node.node_log, rib_sources(state))
        handlers = replace(
            rib_handlers(state, sources, upkeep.store),
            reload=node.reload,
            drain=lambda: runtime.drain(lambda: True, DRAIN_MAX_S),
            is_drained=lambda: runtime.has_drained,
        )
        node.follow_clients(runtime, handlers, config.control_socket)
        for source in upkeep.sources:
            runtime.watch(source, lambda: upkeep.work(now()))
        node.begin(runtime, config.metrics, sources)
        log.info("rib up name=%s iface=%s plane=%s", identity.name.short, config.iface, config.data_plane)
        if runtime.run(lambda: host.attachment.switch is not None):
            ready(identity.name)
        runtime.run()


def _settings(config: RibConfig) -> RibSettings:
    quotas = config.quotas
    return RibSettings(
        upper=config.upper,
        peers=config.peers,
        allow_unowned=config.allow_unowned,
        names_per_sender=quotas.names_per_sender,
        watches=quotas.watches,
        lease_max_s=quotas.lease_max_s,
    )


def _upkeep(config: RibConfig, policy: Policy) -> Upkeep:
    if config.store == "memory":
        return MemoryUpkeep(config.snapshot)
    open_store = _STORES.get("cluster", "store: cluster")
    return open_store(config.store.cluster, policy, allow_unowned=config.allow_unowned)


def rib_handlers(state: RibState, sources: Sources, store: Store) -> ControlHandlers:
    """Return what clients of the control socket may ask of a RIB, which also answers requests about its state."""
    rib = state.host.rib
    answer_for_rib(state)
    return replace(
        common_handlers(
            state,
            sources,
            rib_tables(state, store),
            lambda: {"attached": state.own_switch is not None},
            lambda: rib_snapshot(rib, state.own_switch),
        ),
        lookup=lambda name: rib_lookup(rib, state.identity.name, name, now()),
    )


def rib_sources(state: RibState) -> Sources:
    """Return the sources of metrics that a RIB adds."""
    counters, rib = state.plane.counters, state.host.rib
    return Sources(
        frames=lambda: {"in": counters.frames_in, "out": counters.frames_out, "punted": counters.punted},
        table_entries=lambda: rib.names,
        rib_answers=lambda: {
            "found": rib.state.outbox.answers,
            "negative": rib.state.outbox.negative_answers,
            "unknown": rib.state.outbox.unknown_answers,
            "accepted": rib.state.accepted,
        },
        rib_refusals=lambda: {reason.label: count for reason, count in list(rib.state.refusals.items())},
        clashes=lambda: rib.state.identities.clashes + state.hello_protocol.conflicts.clashes,
    )
