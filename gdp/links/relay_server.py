"""Relay server of a border: accepts members over TLS and gives each a TAP device."""

from __future__ import annotations

import errno
import logging
import select
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gdp.config.relay_config import RelayConfig, RelayServer
from gdp.crypto.certificates import Membership
from gdp.errors import LocalError, StatementError
from gdp.intervals import CONNECT_S, PACE_S, Rate
from gdp.limits import ADDRESS_CONNECTIONS_RATE, CONNECTIONS_RATE
from gdp.links.relay_context import RelayContext
from gdp.links.relay_hello import HelloWait, hand_over
from gdp.links.relay_link import RelayLink, RelayPort, prepare_socket
from gdp.links.relay_loop import RelayLoop
from gdp.names import Name
from gdp.ports.sockets import AS_ROOT
from gdp.ports.tap import TapDevice, tap_name
from gdp.ports.tcp_server import client_network, listen_tcp
from gdp.relay.admission import ClientAdmission, verified_switch
from gdp.relay.connection import ConnectionCounters, Limits, RelayConnection
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBucket, TokenBuckets

log = logging.getLogger(__name__)

_HANDSHAKES_MAX: Final = 32  # unauthenticated connections at once
# connections whose address is looked at: an address above its share costs no handshake
_LOOKS_RATE: Final = Rate(2_000.0, burst=2_000.0)


def listen_tls(config: RelayServer) -> socket.socket:
    """Return the listening socket; without an address it serves IPv4 and IPv6.

    Raises:
        LocalError: the port is in use, needs a right, or the address is not of this host.
    """
    host = "" if config.address is None else str(config.address)
    try:
        listener = listen_tcp(host, config.port)
    except OSError as error:
        where = f"relay server: port {config.port}"
        if error.errno == errno.EADDRINUSE:
            raise LocalError(f"{where} is in use by another program; stop it, or give another server.port") from error
        if error.errno in (errno.EACCES, errno.EPERM):
            raise LocalError(f"{where} needs a right of root; {AS_ROOT}") from error
        raise LocalError(f"{where} at {host or 'any address'}: {error.strerror or error}") from error
    listener.setblocking(False)
    return listener


@dataclass(slots=True)
class _Client:
    """A client that is or was connected; the device and the limits stay for its next connection."""

    member: Membership
    port: RelayPort
    last_s: float
    limits: Limits | None


class BorderServer:
    """The server.

    Args:
        listener: of ``listen_tls``.
        context: identity, policy and TLS of this node.
    """

    def __init__(
        self, config: RelayConfig, server: RelayServer, listener: socket.socket, context: RelayContext
    ) -> None:
        self._config = config
        self._server = server
        self._listener = listener
        self._context = context
        self._loop: RelayLoop = context.loop
        self._clients: dict[Name, _Client] = {}
        self._handshakes: set[RelayLink] = set()
        self._hellos: set[HelloWait] = set()
        self._accepts = TokenBucket(*CONNECTIONS_RATE)
        self._each = TokenBuckets(*ADDRESS_CONNECTIONS_RATE)
        self._looks = TokenBucket(*_LOOKS_RATE)
        self._turned_away = 0
        self._resume_s: float | None = None
        self._ended = ConnectionCounters()
        self.refusals = 0
        self._last_refusal = ""
        allow = None if server.allow is None else frozenset(server.allow)
        own = context.policy.own
        self._admission = ClientAdmission(own_domain=own, allow=allow, clients_max=server.clients_max)
        self._loop.register(listener.fileno(), select.EPOLLIN, self._accept)
        self._loop.add_timed(self)

    @property
    def listening_port(self) -> int:
        """Return the TCP port."""
        return self._server.port

    def handle_timer(self, now_s: float) -> float:
        """Accept connections again after a pause, and end late hellos; return the second of the next call."""
        for hello in [each for each in self._hellos if now_s >= each.since_s + CONNECT_S]:
            self._end_stranger(hello, "no hello in time")
        if self._resume_s is not None and now_s >= self._resume_s:
            self._resume_s = None
            self._loop.register(self._listener.fileno(), select.EPOLLIN, self._accept)
        return now_s + 1.0 if self._resume_s is None else self._resume_s

    def check_members(self, at: Timestamps) -> None:
        """End connections of members whose certificate has expired or was revoked."""
        for client in list(self._clients.values()):
            if client.port.link is not None:
                self._check(client, client.port.link, at)

    def close(self) -> None:
        """End all connections and remove their devices."""
        if self._resume_s is None:
            self._loop.unregister(self._listener.fileno())
        self._listener.close()
        for stranger in self._strangers():
            self._end_stranger(stranger, "the border ends")
        for client in list(self._clients.values()):
            if client.port.link is not None:
                client.port.link.end("the border ends")
            client.port.close()

    def counters(self) -> ConnectionCounters:
        """Return the sum over all connections since the start."""
        total = ConnectionCounters()
        total.add(self._ended)
        for client in self._clients.values():
            total.add(_sum_of(client.port))
        return total

    def status(self, now_s: float) -> dict[str, object]:
        """Return JSON fields about the server and its clients."""
        return {
            "port": self._server.port,
            "clients": [self._client_status(client, now_s) for client in self._clients.values()],
            "refused": self.refusals,
            "turned_away": self._turned_away,
            "last_refusal": self._last_refusal,
        }

    def _client_status(self, client: _Client, now_s: float) -> Mapping[str, object]:
        link = client.port.link
        fields: dict[str, object] = {
            "name": client.member.name.to_text(),
            "label": client.member.label,
            "state": "down" if link is None else "up",
            "rate": self._server.rate,
        }
        return {**fields, **port_status(client.port, now_s)}

    def _accept(self, events: int) -> None:
        del events
        now_s = time.monotonic()
        if self._accepts.left(now_s) < 1.0 or not self._looks.spend(now_s):
            self._pause(now_s)
            return
        try:
            peer, address = self._listener.accept()
            if not self._each.spend(client_network(str(address[0])), now_s):
                self._turned_away += 1
                peer.close()
                return
            self._accepts.charge(now_s, 1.0)
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:  # no descriptors left, which this process cannot repair
            log.warning("connection not accepted reason=%s", error.strerror)
            self._pause(now_s)
            return
        peer.setblocking(False)
        strangers = self._strangers()
        if len(strangers) >= _HANDSHAKES_MAX:  # idle strangers do not keep a member out
            self._end_stranger(min(strangers, key=lambda each: each.since_s), "too many handshakes at once")
        if self._server.enrolment is None:
            self._serve(peer)
        else:
            self._hellos.add(HelloWait(loop=self._loop, accepted=peer, chosen=self._choose))

    def _choose(self, hello: HelloWait, peer: socket.socket, is_enrolment: bool) -> None:
        self._hellos.discard(hello)
        if not is_enrolment or self._server.enrolment is None:
            self._serve(peer)
            return
        try:
            hand_over(peer, self._server.enrolment)
        except OSError as error:
            log.info("connection not handed to the enrolment server reason=%s", error.strerror or error)

    def _serve(self, peer: socket.socket) -> None:
        """Begin the handshake of a relay connection."""
        connection = RelayConnection(
            context=self._context.tls(is_server=True),
            is_server=True,
            settings=self._context.settings(self._server.rate),
            authenticate=self._authenticate,
            now_s=time.monotonic(),
        )
        try:
            prepare_socket(peer, self._config.dead_ms)
            link = RelayLink(
                loop=self._loop, connected=peer, connection=connection, opened=self._open, closed=self._ended_link
            )
        except OSError as error:  # the peer is gone
            log.info("connection gone before its handshake reason=%s", error.strerror)
            peer.close()
            return
        self._handshakes.add(link)

    def _strangers(self) -> list[RelayLink | HelloWait]:
        return [*self._handshakes, *self._hellos]

    def _end_stranger(self, stranger: RelayLink | HelloWait, reason: str) -> None:
        if isinstance(stranger, HelloWait):
            self._hellos.discard(stranger)
        stranger.end(reason)

    def _pause(self, now_s: float) -> None:
        """Leave further connections in the kernel's queue for a moment."""
        self._loop.unregister(self._listener.fileno())
        self._resume_s = now_s + PACE_S
        self._loop.wake_at(self._resume_s)

    def _authenticate(self, certificate: bytes, at: Timestamps) -> Membership:
        member = verified_switch(certificate, self._context.policy.verify_membership, at.unix_s)
        connected = {name: each.member.domain for name, each in self._clients.items() if each.port.link is not None}
        self._admission.check(member, connected)
        return member

    def _open(self, link: RelayLink) -> RelayPort | None:
        """Give an open connection its device; it replaces an older connection of the same client."""
        self._handshakes.discard(link)
        member = link.connection.peer
        if member is None:
            raise LocalError("a connection is open without an authenticated client")
        try:
            client = self._client_of(member, link.connection.limits)
            link.connection.limits = client.limits
            if client.port.link is not None:
                client.port.link.end("replaced by a newer connection of the same client")
            client.port.attach(link)
        except LocalError as error:
            log.error("client without a device name=%s reason=%s", member.name.short, error)
            link.end(f"the border cannot serve its device: {error}", is_refusal=True)
            return None
        client.member, client.last_s = member, time.monotonic()
        log.info("client up label=%s name=%s address=%s", member.label, member.name.short, link.remote)
        return client.port

    def _client_of(self, member: Membership, limits: Limits | None) -> _Client:
        """Return the entry of a client, with a device; the longest disconnected one gives way to a new one.

        Args:
            limits: of a client that is new here.
        """
        known = self._clients.get(member.name)
        if known is not None and not known.port.is_removed:
            return known
        if known is not None:
            self._forget(known)
        while len(self._clients) >= self._server.clients_max:
            idle = [each for each in self._clients.values() if each.port.link is None]
            if not idle:
                raise LocalError("all clients are connected")
            self._forget(min(idle, key=lambda each: each.last_s))
        own = self._context.identity.name
        device = TapDevice(tap_name(own, member.name), self._context.alias, self._config.mtu)
        client = _Client(member, RelayPort(self._loop, device), time.monotonic(), limits)
        self._clients[member.name] = client
        return client

    def _forget(self, client: _Client) -> None:
        self._ended.add(_sum_of(client.port))
        client.port.close()
        del self._clients[client.member.name]

    def _ended_link(self, link: RelayLink) -> None:
        self._handshakes.discard(link)
        connection = link.connection
        member = connection.peer
        who = "unknown" if member is None else f"{member.label} {member.name.short}"
        if connection.was_refused:
            self.refusals += 1
            self._last_refusal = connection.reason
            log.warning("client refused client=%s address=%s reason=%s", who, link.remote, connection.reason)
        elif member is None:
            self.refusals += 1
            log.info("handshake failed address=%s reason=%s", link.remote, connection.reason)
        else:
            client = self._clients.get(member.name)
            if client is not None:
                client.last_s = time.monotonic()
            log.info("client down client=%s reason=%s", who, connection.reason)

    def _check(self, client: _Client, link: RelayLink, at: Timestamps) -> None:
        try:
            self._context.policy.check_member(client.member, at.unix_s)
        except StatementError as error:
            link.end(f"the membership of {client.member.label} is no longer valid: {error}", is_refusal=True)


def port_status(port: RelayPort, now_s: float) -> dict[str, object]:
    """Return JSON fields about a device and its connection."""
    total, link = _sum_of(port), port.link
    return {
        "device": port.device.ifname,
        "address": "" if link is None else link.remote,
        "up_s": 0.0 if link is None else round(now_s - link.since_s, 1),
        "mtu": None if link is None else link.connection.mtu,
        "queued_bytes": 0 if link is None else link.connection.queued_bytes,
        **counter_fields(total),
    }


def counter_fields(counters: ConnectionCounters) -> dict[str, object]:
    """Return counters as JSON fields."""
    return {
        "frames_in": counters.frames_in,
        "frames_out": counters.frames_out,
        "bytes_in": counters.bytes_in,
        "bytes_out": counters.bytes_out,
        "drops": {
            "foreign": counters.foreign,
            "too-big": counters.too_big,
            "queue-full": counters.full,
            "device": counters.refused,
        },
    }


def _sum_of(port: RelayPort) -> ConnectionCounters:
    total = ConnectionCounters()
    total.add(port.ended)
    if port.link is not None:
        total.add(port.link.connection.counters)
    return total
