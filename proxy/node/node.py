"""Proxy node: a participant of the overlay on one device, with the names that its configuration makes global."""

from __future__ import annotations

import contextlib
import logging
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import FrameType

from gdp.client.clock_exchange import ClockExchange
from gdp.client.participant import Participant, Topic
from gdp.crypto.certificates import Role
from gdp.due_queue import earliest
from gdp.errors import GdpError, LocalError
from gdp.intervals import GOODBYE_S, LINGER_S, UPKEEP_S
from gdp.links.uplink import load_plane, open_uplink
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore, EpochTimer
from gdp.nodes.membership import fresh_settings, load_member
from gdp.nodes.node import Node, common_sources
from gdp.nodes.node_log import OnWait
from gdp.nodes.rights import confine_proxy
from gdp.runtime.runtime import Runtime, now
from gdp.session.kept_topics import CAPSULES
from proxy.bridge.bridge import Bridge
from proxy.bridge.keeping import TopicKeeper
from proxy.config.config import ProxyConfig
from proxy.node.proxy_state import ProxyState, proxy_handlers, proxy_sources

log = logging.getLogger(__name__)


class ProxyNode(Node):
    """The running node, for the command that drives it.

    Attributes:
        on_reload: reads the configuration again; raises ``GdpError`` where the old one stays. None: not supported.
        is_leaving: a SIGUSR1 or a drain arrived: answer what is under way, then end.
        has_drained: all that was under way was answered.
        drains: whether the command checks ``is_leaving``; else a SIGUSR1 ends it at once.

    Raises:
        LocalError: keys or the device are not as configured, or this proxy already runs.
    """

    def __init__(self, config: ProxyConfig, stack: contextlib.ExitStack, on_wait: OnWait | None) -> None:
        member = load_member(config.identity, config.domain, Role.PROXY)
        super().__init__("proxy", member, config, stack, state_folder=config.state)
        self.member = Participant(self.identity, self.policy, fresh_settings(config.lease_s))
        plane = stack.enter_context(open_uplink(config.iface, load_plane(config.data_plane, stack)))
        self.runtime = Runtime(self.member, plane, spin_s=config.busy_poll_us / 1e6)
        self.state = ProxyState(self.identity, self.policy, plane, self.member, now().mono_s, _rule_names(config))
        self.on_reload: Callable[[], None] | None = None
        self.is_leaving = self.drains = self.has_drained = False
        self.drive(self.state, self.runtime, on_wait)

    def reload(self) -> None:
        """Read the certificates, the configuration and the delegations again.

        Raises:
            GdpError: the old configuration stays in use; the text states why.
        """
        super().reload()
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

    def open_keeper(self, settings: ProxyConfig, held: DelegationStore) -> TopicKeeper:
        """Return the keeper of topics; rules that need it may come with a reload."""
        folder = Path() if settings.state is None else settings.state / CAPSULES
        return TopicKeeper(self.member, self.identity, folder, held)

    def leave_soon(self, number: int, frame: FrameType | None) -> None:
        """Handle a SIGUSR1, which wakes the loop."""
        del number, frame
        self.drain()

    def leave(self) -> None:
        """Leave the overlay, stopped or not, and run until the goodbye is sent."""
        self.member.leave()
        self.runtime.linger(time.monotonic() + GOODBYE_S)

    def say_goodbye(self, bridge: Bridge) -> None:
        """End all flows, and leave the overlay, also after a signal; a second signal ends each wait."""
        bridge.finish()
        self.runtime.linger(time.monotonic() + LINGER_S, lambda: bridge.is_finished)
        bridge.close()
        self.leave()

    def step(self, bridge: Bridge, latest_s: float | None = None) -> float:
        """Wait for an event, no longer than until a monotonic second, and have the bridge handle it; return the time.

        All pending messages are flushed once, so that small ones share a seal.
        """
        self.runtime.step(earliest(bridge.get_timer(), latest_s))
        return self.work(bridge)

    def work(self, bridge: Bridge) -> float:
        """Have a bridge handle its events and the messages of the overlay; return the monotonic second."""
        now_s = time.monotonic()
        bridge.work(now_s)
        self.member.flush(now_s)
        return now_s

    def tell_refusals(self) -> None:
        """Log a warning for each advertisement that the overlay has rejected."""
        for each in self.member.attachment.advertisements:
            if each.refused is not None:
                name, right, reason = each.subject.name.short, each.right.value, each.refused.label
                log.warning("advertisement refused name=%s right=%s reason=%s", name, right, reason)


@contextlib.contextmanager
def run_node(config: ProxyConfig, on_wait: OnWait | None = None) -> Iterator[ProxyNode]:
    """Open everything that a proxy needs; close it on leaving.

    Args:
        on_wait: called with reason and text when the proxy reports a wait.

    Raises:
        LocalError: keys, delegations or the device are not as configured, or this proxy already runs.
    """
    with contextlib.ExitStack() as stack:
        node = ProxyNode(config, stack, on_wait)
        runtime = node.runtime
        stack.callback(signal.signal, signal.SIGUSR1, signal.signal(signal.SIGUSR1, node.leave_soon))
        runtime.every(UPKEEP_S, EpochTimer(node.reload_on_signal).handle_timer)
        runtime.every(UPKEEP_S, ClockExchange(node.member).work)
        sources = common_sources(node.node_log, proxy_sources(node.state))
        handlers = replace(
            proxy_handlers(node.state, sources),
            reload=node.reload,
            drain=node.drain,
            is_drained=lambda: node.has_drained,
        )
        node.follow_clients(runtime, handlers, config.control_socket, node.reload_on_signal)
        if config.sandbox:
            files = (None if config.record is None else config.record.path, config.control_socket)
            folders = (None if each is None else each.parent for each in files)
            confine_proxy(config, [config.delegations], [*folders, config.state], has_ros=bool(config.ros))
        node.begin(runtime, config.metrics, sources)
        log.info("proxy up name=%s iface=%s", node.identity.name.short, config.iface)
        yield node


def _rule_names(config: ProxyConfig) -> Mapping[Name, str]:
    """Return the local names of rules with a type, by overlay name; a pattern has none."""
    rules = [rule for rule in (*config.expose, *config.imports) if rule.type_name and not rule.is_pattern]
    return {rule.overlay_name: rule.name for rule in rules}


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
