"""Relay client of a member: dials one border, and again after each loss or change of address.

I/O. A thread resolves host names, because that blocks. The TAP device stays for the process; its carrier follows the
connection.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import os
import queue
import random
import select
import socket
import threading
import time
from typing import Final, NamedTuple

from gdp.config.relay_config import RelayBorder
from gdp.crypto.certificates import Membership
from gdp.errors import LocalError, StatementError
from gdp.host_port import split_host_port
from gdp.intervals import REFUSED_S, TRY_S
from gdp.links.relay_context import RelayContext
from gdp.links.relay_link import RelayLink, RelayPort, prepare_socket
from gdp.links.relay_server import port_status
from gdp.names import Name
from gdp.ports.host_addresses import source_address
from gdp.ports.tap import TapDevice, tap_name
from gdp.relay.admission import verified_border
from gdp.relay.choice import RelayChoice
from gdp.relay.connection import ConnectionCounters, RelayConnection
from gdp.requests import Backoff
from gdp.sansio import Timestamps

log = logging.getLogger(__name__)

_REDIALS: Final = Backoff(0.1, 5.0)
_CANDIDATES_MAX: Final = 16
_STANDBY: Final = "on standby: the tunnel over UDP is up, or has a moment to come up"


class _Candidate(NamedTuple):
    """A resolved endpoint; ``host`` is as configured, for the server name indication."""

    host: str
    address: str
    port: int


class BorderDialer:
    """The client of one border.

    Args:
        border: its name and endpoints.

    Raises:
        LocalError: the TAP device cannot be made.
    """

    def __init__(self, border: RelayBorder, context: RelayContext) -> None:
        self._border = border
        self._context = context
        self._loop = context.loop
        self._failures = 0  # since a connection stood, or the network changed
        self._candidates: list[_Candidate] = []
        self._next = 0
        self._source: str | None = None  # of the last attempt: the own address towards the border
        self._connecting: socket.socket | None = None
        self._target: _Candidate | None = None
        self._link: RelayLink | None = None
        self._due_s: float | None = 0.0  # of the next attempt, or of giving up the present one
        self._results: queue.SimpleQueue[list[_Candidate] | str] = queue.SimpleQueue()
        self._resolved, self._resolves = socket.socketpair()
        self._is_resolving = False
        self._is_closed = False
        self._is_wanted = not border.standby
        self._choice = RelayChoice(begun_s=time.monotonic())
        self._last_refusal = ""
        self.attempts = 0
        self.reason = _STANDBY if border.standby else "not tried yet"
        self.port = self._new_port()
        self._resolved.setblocking(False)
        self._loop.register(self._resolved.fileno(), select.EPOLLIN, self._take_resolved)
        self._loop.add_timed(self)

    @property
    def peer(self) -> Name:
        """Return the name of the border's switch."""
        return self._border.peer

    @property
    def is_up(self) -> bool:
        """Return whether frames pass."""
        return self.port.link is not None

    def handle_timer(self, now_s: float) -> float:
        """Dial, or give up an attempt, when it is due; return the second of the next call."""
        if self._is_wanted and self._due_s is not None and now_s >= self._due_s:
            self._due_s = None
            if self._connecting is not None:
                self._failed("no answer from the endpoint")
            elif self._link is None:
                self._dial()
        return now_s + 1.0 if self._due_s is None or not self._is_wanted else self._due_s

    def follow_tunnel(self, now_s: float, *, is_up: bool) -> None:
        """Take in whether the switch's tunnel to this border is up: a border on standby is dialled while it is not."""
        if not self._border.standby:
            return
        is_wanted = self._choice.update(now_s, is_udp_up=is_up)
        if is_wanted is self._is_wanted:
            return
        self._is_wanted = is_wanted
        log.info("relay %s border=%s", "needed: no tunnel" if is_wanted else "on standby", self._border.peer.short)
        if is_wanted:
            self._dial_now()
            return
        self._drop_attempt()
        if self._link is not None:
            self._link.end(_STANDBY)
        self.reason = _STANDBY

    def network_changed(self) -> None:
        """Connect again at once if the own address towards the border has changed."""
        target, link = self._target, self._link
        if not self._is_wanted:
            return
        if target is None:
            if not self._is_resolving:
                self._dial_now()
            return
        source = source_address(target.address)
        if source == (self._source if link is None else link.local):
            return
        log.info("own address changed border=%s", self._border.peer.short)
        self._source = source
        if link is not None:
            link.end("the address of this host changed")
        elif self._connecting is not None:
            self._drop_attempt()
        if source is not None:
            self._dial_now()

    def check_member(self, at: Timestamps) -> None:
        """End the connection if the border's membership has expired or was revoked."""
        link = self.port.link
        if link is None or link.connection.peer is None:
            return
        try:
            self._context.policy.check_member(link.connection.peer, at.unix_s)
        except StatementError as error:
            link.end(f"the membership of the border is no longer valid: {error}", is_refusal=True)

    def close(self) -> None:
        """End the connection and remove the device."""
        self._is_closed = True
        self._due_s = None
        if self._connecting is not None:
            self._drop_attempt()
        if self._link is not None:
            self._link.end("this node ends")
        self._loop.remove_timed(self)
        self._loop.unregister(self._resolved.fileno())
        self._resolved.close()
        self._resolves.close()
        self.port.close()

    def counters(self) -> ConnectionCounters:
        """Return the sum over all connections since the start."""
        total = ConnectionCounters()
        total.add(self.port.ended)
        if self.port.link is not None:
            total.add(self.port.link.connection.counters)
        return total

    @property
    def waiting(self) -> str:
        """What the connection waits for, as a sentence; empty: it is up, or on standby."""
        if self.is_up or not self._is_wanted:
            return ""
        return f"no connection to border {self._border.peer.short}: {self.reason or 'connecting'}"

    def status(self, now_s: float) -> dict[str, object]:
        """Return JSON fields about the connection."""
        return {
            "name": self._border.peer.to_text(),
            "endpoints": list(self._border.endpoints),
            "state": "up" if self.is_up else "connecting" if self._is_wanted else "standby",
            "reason": "" if self.is_up else self.reason,
            "attempts": self.attempts,
            **port_status(self.port, now_s),
        }

    def _new_port(self) -> RelayPort:
        own, peer = self._context.identity.name, self._border.peer
        device = TapDevice(tap_name(own, peer), self._context.alias, self._context.config.mtu)
        return RelayPort(self._loop, device)

    def _dial_now(self) -> None:
        self._failures = 0
        self._due_s = time.monotonic()
        self._loop.wake_at(self._due_s)

    def _dial(self) -> None:
        """Try the next address; resolve the endpoints first, once for each round."""
        if self._is_resolving:
            return
        if self.port.is_removed and not self._renew_port():
            return
        if self._next >= len(self._candidates):
            self._next = 0
            self._resolve()
            return
        target = self._candidates[self._next]
        self._next += 1
        self.attempts += 1
        self._target = target
        self._source = source_address(target.address)
        family = socket.AF_INET6 if ":" in target.address else socket.AF_INET
        opened = socket.socket(family, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        prepare_socket(opened, self._context.config.dead_ms)
        self._connecting = opened
        number = opened.connect_ex((target.address, target.port))
        if number not in (0, errno.EINPROGRESS):
            opened.close()
            self._connecting = None
            self._failed(os.strerror(number))
            return
        self._due_s = time.monotonic() + TRY_S
        self._loop.wake_at(self._due_s)
        self._loop.register(opened.fileno(), select.EPOLLOUT, self._connected)

    def _renew_port(self) -> bool:
        """Make the device again, which another program removed; return whether there is one now."""
        try:
            port = self._new_port()
        except LocalError as error:
            self._failed(str(error))
            return False
        port.ended.add(self.port.ended)
        self.port.close()
        self.port = port
        return True

    def _connected(self, events: int) -> None:
        del events
        opened, target = self._connecting, self._target
        if opened is None or target is None:
            return
        number = opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if number:
            self._failed(os.strerror(number))
            return
        self._loop.unregister(opened.fileno())
        self._connecting, self._due_s = None, None
        host = "" if target.host == target.address else target.host
        try:
            connection = RelayConnection(
                context=self._context.tls(is_server=False),
                is_server=False,
                host=host,
                settings=self._context.settings(None),
                authenticate=self._authenticate,
                now_s=time.monotonic(),
            )
            self._link = RelayLink(
                loop=self._loop, connected=opened, connection=connection, opened=self._open, closed=self._ended
            )
        except (LocalError, OSError) as error:  # it was lost in the meantime
            opened.close()
            self._wait(str(error))

    def _authenticate(self, certificate: bytes, at: Timestamps) -> Membership:
        return verified_border(certificate, self._border.peer, self._context.policy.verify_membership, at.unix_s)

    def _open(self, link: RelayLink) -> RelayPort | None:
        try:
            self.port.attach(link)
        except LocalError as error:
            link.end(str(error))
            return None
        self._failures = 0
        self._next = max(self._next - 1, 0)  # the same endpoint first, if the connection is lost
        self._last_refusal = ""
        self.reason = ""
        log.info("relay up via=tls border=%s address=%s device=%s", *self._shown(link), self.port.device.ifname)
        return self.port

    def _ended(self, link: RelayLink) -> None:
        self._link = None
        connection = link.connection
        self.reason = connection.reason
        if connection.was_refused:
            if self._last_refusal != self.reason:
                log.error("relay refused border=%s address=%s reason=%s", *self._shown(link), self.reason)
            self._last_refusal = self.reason
            self._wait(self.reason, at_least_s=REFUSED_S)
            return
        log.info("relay down border=%s address=%s reason=%s", *self._shown(link), self.reason)
        self._wait(self.reason)

    def _shown(self, link: RelayLink) -> tuple[str, str]:
        return self._border.peer.short, link.remote

    def _failed(self, reason: str) -> None:
        """Give up the present attempt; the next address follows at once, the next round after a wait."""
        self._drop_attempt()
        if self._next < len(self._candidates):
            self.reason = reason
            self._due_s = time.monotonic()
            self._loop.wake_at(self._due_s)
        else:
            self._wait(reason)

    def _wait(self, reason: str, at_least_s: float = 0.0) -> None:
        if reason != self.reason:
            log.debug("relay not connected border=%s reason=%s", self._border.peer.short, reason)
        self.reason = reason
        if self._is_closed:
            return
        self._failures += 1
        wait_s = max(_REDIALS.random_pause_s(self._failures, random.random()), at_least_s)
        self._due_s = time.monotonic() + wait_s
        self._loop.wake_at(self._due_s)

    def _drop_attempt(self) -> None:
        if self._connecting is not None:
            self._loop.unregister(self._connecting.fileno())
            self._connecting.close()
            self._connecting = None

    def _resolve(self) -> None:
        endpoints = [split_host_port(each) for each in self._border.endpoints]
        if all(_is_numeric(host) for host, _ in endpoints):
            self._take([_Candidate(host, host, port) for host, port in endpoints])
            return
        self._is_resolving = True
        threading.Thread(target=self._resolve_all, args=(endpoints,), name="resolver", daemon=True).start()

    def _resolve_all(self, endpoints: list[tuple[str, int]]) -> None:
        """Resolve in a thread, and report the result to the loop."""
        found: list[_Candidate] = []
        reason = ""
        for host, port in endpoints:
            try:
                answers = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            except OSError as error:
                reason = f"{host}: {error.strerror}"
                continue
            found += [_Candidate(host, str(name[0]), port) for _, _, _, _, name in answers]
        self._results.put(found or reason)
        try:
            self._resolves.send(b"\0")
        except OSError:  # the relay has ended in the meantime
            log.debug("resolver without a reader")

    def _take_resolved(self, events: int) -> None:
        del events
        self._resolved.recv(16)
        self._is_resolving = False
        result = self._results.get()
        if isinstance(result, str):
            self._wait(result)
        else:
            self._take(result)

    def _take(self, candidates: list[_Candidate]) -> None:
        self._candidates = candidates[:_CANDIDATES_MAX]
        self._dial_candidate()

    def _dial_candidate(self) -> None:
        if self._link is None and self._connecting is None and self._candidates:
            self._dial()


def _is_numeric(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
