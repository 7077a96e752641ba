"""Node of any kind, assembled from declared parts in one order, and closed in the reverse one.

I/O. The kinds differ in the core, the plane and what clients may ask; the rest is here::

    Node            identity and policy, lock of the identity, service manager, stored revocations, audit folder
    build_core      the core, with a journal where the configuration has one
    drive           log of neighbours and waits, measured links, credentials: periodic calls of the loop
    follow_clients  signals, watchdog, control socket
    confine         the rights that are no longer needed
    begin           what writes from now on: audit log, revocations; metrics

``confine`` drops rights of the present thread and of those that start later, so all that starts threads comes after
it. A RIB confines itself before ``drive``, because its store starts threads when it opens; its device can be opened
without the rights that are dropped. A switch makes devices and loads programs first.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from gdp.config.schema import Metrics
from gdp.control.hello import NodeSettings
from gdp.crypto.identity import Identity
from gdp.host.service_notifier import service_notifier
from gdp.host.single_instance import run_alone
from gdp.intervals import PACE_S, TICK_S, UPKEEP_S
from gdp.links.relay_loop import RelayLoop
from gdp.management.control_client import control_path
from gdp.management.control_socket import ControlHandlers, ControlServer
from gdp.names import Name
from gdp.nodes.audit import NodeAudit
from gdp.nodes.credentials import Credentials, NodeConfig
from gdp.nodes.decision_log import log_decisions
from gdp.nodes.node_log import NodeLog, OnWait
from gdp.nodes.revocation_upkeep import RevocationUpkeep
from gdp.ports.port_counters import PortCounters
from gdp.runtime.runtime import Runtime, now
from gdp.state.control_status import node_status
from gdp.state.diagnostic_control import DiagnosticCommands, TableSource
from gdp.state.node_state import NodeState
from gdp.state.snapshot import node_snapshot
from gdp.stores.audit_log import AuditLog
from gdp.telemetry.sources import Sources
from gdp.trust.domain import Policy

if TYPE_CHECKING:
    from gdp.journal.journal import Journal
    from gdp.rib.state import RibSettings

log = logging.getLogger(__name__)


Loop: TypeAlias = Runtime | RelayLoop
_C = TypeVar("_C")


class Node:
    """The parts of one node.

    Args:
        word: for the kind of node in errors, such as ``switch``.
        member: as from ``load_member``.
        stack: closes the parts.
        is_service: it may have a service manager, whose messages are its own; not in the process of a user's program.
        state_folder: keeps revocations across restarts; None: they are kept in memory only.
        audit: folder of its audit log; None: it keeps none.
        instance: name whose lock and control socket it has; None: its own.

    Attributes:
        node_log: from ``drive`` on.

    Raises:
        LocalError: this node runs already, or others may write to a folder.
    """

    node_log: NodeLog

    def __init__(
        self,
        word: str,
        member: tuple[Identity, Policy],
        config: NodeConfig,
        stack: contextlib.ExitStack,
        *,
        is_service: bool = True,
        state_folder: Path | None = None,
        audit: Path | None = None,
        instance: Name | None = None,
    ) -> None:
        self.identity, self.policy = member
        self._stack = stack
        self._instance = self.identity.name if instance is None else instance
        stack.enter_context(run_alone(word, self._instance))
        self._notifier = stack.enter_context(service_notifier()) if is_service else None
        self._revocations = RevocationUpkeep(state_folder, self.policy.revoked)
        self._revocations.restore(now())
        stack.callback(self._revocations.close)
        self._counters = PortCounters()
        stack.callback(self._counters.close)
        self._audit_log = None if audit is None else AuditLog(audit)
        self._journal: Journal | None = None
        self._credentials = Credentials(config.identity, config.domain, self.identity, self.policy)

    def build_core(
        self,
        make: Callable[[Identity, Policy, NodeSettings], _C],
        settings: NodeSettings,
        journal_mib: int | None,
        *,
        rib: RibSettings | None = None,
        unrepeatable: str = "",
    ) -> _C:
        """Return the node's core.

        Args:
            journal_mib: MiB of memory for its journal; None: it keeps none.
            rib, unrepeatable: as in ``Journal``.
        """
        if journal_mib is None:
            return make(self.identity, self.policy, settings)
        from gdp.journal.journal import Journal  # it loads more of a RIB than a library needs

        self._journal = Journal(journal_mib << 20, unrepeatable)
        return self._journal.build(make, self.identity, self.policy, settings, now(), rib)

    def drive(self, state: NodeState, loop: Loop, on_wait: OnWait | None = None) -> None:
        """Log from within the loop what changes, and measure the links.

        Args:
            on_wait: called with reason and text when the node reports what it waits for.
        """
        self.node_log = NodeLog(state, on_wait)
        state.read_devices = self._counters.read
        for follow in (self.node_log.log_changes, state.refresh):
            loop.every(UPKEEP_S, follow)
        log_decisions(loop.every, state)
        self.follow_credentials(loop)

    def follow_credentials(self, loop: Loop) -> None:
        """Read certificates and roots again from within the loop, when they change."""
        loop.every(UPKEEP_S, self._credentials.reload_changed)

    def reload(self) -> None:
        """Read certificates and roots again, where they changed."""
        self._credentials.reload_changed(now())

    def follow_clients(
        self,
        loop: Loop,
        handlers: ControlHandlers,
        path: Path | None,
        hang_up: Callable[[], None] | None = None,
    ) -> None:
        """Follow signals, the watchdog and clients of the control socket from within the loop.

        Args:
            path: of the control socket; None: the usual one.
            hang_up: called after a SIGHUP; None: the reload of the handlers.

        Raises:
            LocalError: the socket cannot be made.
        """
        self._stack.enter_context(loop.signals(hang_up or handlers.reload))
        if self._notifier is not None:
            self._notifier.follow(loop.every)
        if (journal := self._journal) is not None:
            ports = self.node_log.state.plane.ports
            handlers = replace(
                handlers,
                incident=lambda arguments: journal.page(
                    arguments, {each.index: each.ifname for each in ports.values()}
                ),
            )
        self._stack.enter_context(_served(loop, path or control_path(self._instance), handlers))

    def begin(self, loop: Loop, metrics: Metrics | None = None, sources: Sources | None = None) -> None:
        """Start what writes or answers in threads of its own, after the confinement.

        Raises:
            LocalError: the port of the metrics is in use.
        """
        if self._audit_log is not None:
            audit = NodeAudit(self._audit_log, self.policy.audit, self.node_log.state.core.drops)
            loop.every(TICK_S, audit.write_pending)
            self._stack.callback(lambda: audit.write_pending(now()))
        self._revocations.start()
        loop.every(PACE_S, self._revocations.work, self._revocations.has_work)
        if metrics is not None and sources is not None:
            from gdp.telemetry import metrics as server  # its library takes a tenth of a node's start

            served = server.Metrics(sources)
            served.serve(metrics.port)
            self._stack.callback(served.close)


def common_sources(node_log: NodeLog, own: Sources) -> Sources:
    """Return the sources of metrics of a kind of node with those that every kind has."""
    state = node_log.state
    return replace(
        own,
        drops=state.drops,
        waiting=node_log.metrics,
        links=lambda: state.links,
        clocks=lambda: {member.name.short: clock for member, clock in state.clocks},
        ports=state.ports,
        health=node_log.health,
    )


def common_handlers(
    state: NodeState,
    sources: Sources,
    tables: Mapping[str, TableSource],
    status: Callable[[], dict[str, object]],
    snapshot: Callable[[], Mapping[str, object]],
) -> ControlHandlers:
    """Return what clients of the control socket may ask of every kind of node; only its loop can reload and drain.

    Args:
        status, snapshot: return the fields that this kind of node adds.
    """
    commands = DiagnosticCommands(state=state, now=now, tables=tables)

    def show_status() -> Mapping[str, object]:
        """Return the JSON fields of the node."""
        return node_status(state.identity, sources, uptime_s=state.uptime_s(now().mono_s), **status())

    return ControlHandlers(
        status=show_status,
        snapshot=lambda: {**node_snapshot(state, sources, now().mono_s), **snapshot()},
        ask=commands.ask,
        show=commands.show,
    )


@contextlib.contextmanager
def _served(loop: Loop, path: Path, handlers: ControlHandlers) -> Iterator[None]:
    """Serve a control socket from within the loop until the context ends."""
    if not path.parent.is_dir():  # locks are not possible here either, which was logged
        log.warning("no control socket: no such directory path=%s", path.parent)
        yield
        return
    server = ControlServer(path, handlers)
    loop.watch(server, server.handle_events)
    try:
        yield
    finally:
        loop.unwatch(server)
        server.close()
