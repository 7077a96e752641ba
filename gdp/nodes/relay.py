"""Relay node (``gdp-relay``): carries a switch's frames through TLS where UDP is blocked.

I/O. On a border it is a server, on a member it dials borders; both ends have one TAP device for each connection, which
is an ordinary port of the switch. It is slower than a tunnel, because each byte passes this process and TCP.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import time
from collections.abc import Callable
from pathlib import Path

from gdp.config.relay_config import RelayConfig
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import DropReason
from gdp.intervals import TICK_S
from gdp.links.relay_context import RelayContext
from gdp.links.relay_dialer import BorderDialer
from gdp.links.relay_loop import RelayLoop
from gdp.links.relay_ports import VIA
from gdp.links.relay_server import BorderServer, listen_tls
from gdp.management.control_client import control_path
from gdp.management.control_socket import ControlHandlers
from gdp.management.switch_watch import SwitchWatch
from gdp.names import Name
from gdp.nodes.membership import load_member
from gdp.nodes.node import Node
from gdp.nodes.rights import confine_relay
from gdp.ports.host_addresses import AddressMonitor
from gdp.ports.tap import TapDevice, tap_name
from gdp.relay.connection import ConnectionCounters
from gdp.runtime.runtime import now
from gdp.state.control_status import node_status
from gdp.telemetry.health import Health
from gdp.telemetry.sources import Sources

log = logging.getLogger(__name__)


def relay_control_path(config: RelayConfig, switch: Name) -> Path:
    """Return the control socket of the relay of a switch, which has one of its own."""
    return config.control_socket or control_path(_instance(switch))


def run_relay(config: RelayConfig, ready: Callable[[Identity, Relay], None]) -> None:
    """Run a relay until a signal or a drain ends it.

    Args:
        ready: called once after the start.

    Raises:
        LocalError: keys, the port or the system's rights do not allow it, or this relay already runs.
    """
    identity, policy = member = load_member(config.identity, config.domain, Role.SWITCH)
    with contextlib.ExitStack() as stack:
        node = Node("relay", member, config, stack, instance=_instance(identity.name))
        loop = RelayLoop()
        stack.callback(loop.close)
        node.follow_credentials(loop)
        relay = Relay(RelayContext(config=config, identity=identity, policy=policy, loop=loop))
        stack.callback(relay.close)

        def reload() -> None:
            node.reload()
            relay.check_members()

        handlers = ControlHandlers(reload=reload, status=relay.status, drain=loop.stop)
        node.follow_clients(loop, handlers, config.control_socket)
        if config.sandbox:
            confine_relay(config)
        node.begin(loop, config.metrics, relay.sources())
        log.info(
            "relay up name=%s role=%s server=%s", identity.name.short, identity.role.value, relay.server is not None
        )
        relay.start()
        ready(identity, relay)
        loop.run()


class Relay:
    """The server and the dialers of one process. Raises ``LocalError``: the port, a TAP device or TLS cannot be had."""

    def __init__(self, context: RelayContext) -> None:
        self._context = context
        self._loop = context.loop
        self._begun_s = time.monotonic()
        self._health = Health()
        self._is_closed = False
        context.load_revocations(now())
        context.tls(is_server=False)
        self.server: BorderServer | None = None
        self.dialers: list[BorderDialer] = []
        switch = context.config.switch_socket or control_path(context.identity.name)
        self._watch = SwitchWatch(switch) if any(each.standby for each in context.config.borders) else None
        with contextlib.ExitStack() as opened:
            config = context.config
            self._monitor = opened.enter_context(contextlib.closing(AddressMonitor()))
            for border in config.borders:
                dialer = BorderDialer(border, context)
                opened.callback(dialer.close)
                self.dialers.append(dialer)
            if config.server is not None:
                own = context.identity.name
                TapDevice(tap_name(own, own), context.alias, config.mtu).close()  # fails now, not at the first client
                listener = opened.enter_context(listen_tls(config.server))
                self.server = BorderServer(config, config.server, listener, context)
            opened.pop_all()
        self._loop.watch(self._monitor, self._addresses_changed)
        self._loop.add_timed(self)

    def start(self) -> None:
        """Begin to follow the switch's tunnels, after the confinement of rights."""
        if self._watch is not None:
            self._watch.start()

    def handle_timer(self, now_s: float) -> float:
        """Look at files and memberships; return the second of the next call."""
        self.check_members()
        if self._watch is not None:
            for dialer in self.dialers:
                dialer.follow_tunnel(now_s, is_up=dialer.peer.to_text() in self._watch.up)
        self._health = Health(now_s, tuple(filter(None, (dialer.waiting for dialer in self.dialers))))
        return now_s + TICK_S

    def check_members(self) -> None:
        """Read new revocations, and end connections of members that are no longer valid."""
        moment = now()
        self._context.load_revocations(moment)
        if self.server is not None:
            self.server.check_members(moment)
        for dialer in self.dialers:
            dialer.check_member(moment)

    def close(self) -> None:
        """End all connections, and remove their devices."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._watch is not None:
            self._watch.close()
        self._loop.remove_timed(self)
        self._loop.unwatch(self._monitor)
        self._monitor.close()
        for dialer in self.dialers:
            dialer.close()
        if self.server is not None:
            self.server.close()

    def counters(self) -> ConnectionCounters:
        """Return the sum over all connections since the start."""
        total = ConnectionCounters()
        for part in (*self.dialers, *(() if self.server is None else (self.server,))):
            total.add(part.counters())
        return total

    def sources(self) -> Sources:
        """Return the functions that metrics read."""

        def frames() -> dict[str, int]:
            """Return the frames by direction, as the switch sees it."""
            total = self.counters()
            return {"in": total.frames_in, "out": total.frames_out}

        return Sources(frames=frames, drops=self._drops, health=lambda: self._health)

    def status(self) -> dict[str, object]:
        """Return the JSON fields of this relay."""
        now_s, total = time.monotonic(), self.counters()
        more: dict[str, object] = {"via": VIA, "bytes_in": total.bytes_in, "bytes_out": total.bytes_out}
        if self.server is not None:
            more["server"] = self.server.status(now_s)
        more["borders"] = [dialer.status(now_s) for dialer in self.dialers]
        uptime_s = now_s - self._begun_s
        return {**node_status(self._context.identity, self.sources(), uptime_s=uptime_s, **more), "role": "relay"}

    def _addresses_changed(self) -> None:
        if self._monitor.has_news():
            for dialer in self.dialers:
                dialer.network_changed()

    def _drops(self) -> dict[DropReason, int]:
        total = self.counters()
        return {
            DropReason.BAD_ETHERTYPE: total.foreign,
            DropReason.TOO_BIG: total.too_big,
            DropReason.PORT_FULL: total.full,
            DropReason.PORT_DOWN: total.refused,
        }


def _instance(switch: Name) -> Name:
    """Return the name under which the relay of a switch holds its lock, for the switch itself holds its own."""
    return Name(hashlib.sha256(b"gdp-relay-instance-1" + switch).digest())
