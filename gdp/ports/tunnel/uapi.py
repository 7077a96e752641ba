"""Userspace interface of WireGuard: the text protocol by which ``wireguard-go`` is configured.

I/O; one connection to the Unix socket of the device for each request. Source: https://www.wireguard.com/xplatform/. A
request and its reply are lines of ``key=value``, ended by an empty line; keys are hexadecimal::

    set=1                     get=1
    listen_port=51820
    public_key=...            private_key=...
                              errno=0
"""

from __future__ import annotations

import errno
import os
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.intervals import ANSWER_S, LOOK_S, RETRY_S
from gdp.ports.tunnel.control import Change, ControlLostError, DeviceState, PeerChange, PeerState

SOCKET_FOLDER: Final = Path("/var/run/wireguard")  # wireguard-go allows no other
_BIND_TRIES: Final = 10  # a keeper that enlarges the buffers of a socket holds its port open for a moment
_REPLY_MAX_BYTES: Final = 4 << 20
_NANO: Final = 1e-9


class _PortTakenError(LocalError):
    """The UDP port is in use."""


def socket_path(ifname: str) -> Path:
    """Return the control socket of a device; names of devices are therefore unique on a host."""
    return SOCKET_FOLDER / f"{ifname}.sock"


class UserspaceControl:
    """Control of the device of a ``wireguard-go`` process, as ``WireGuardControl``.

    After a request without a reply, further ones fail at once for a while: a process that hangs must not slow a node.
    """

    def __init__(self, ifname: str) -> None:
        self._ifname = ifname
        self._silent_until_s = 0.0

    def apply(self, change: Change) -> None:
        """Change the device."""
        request = request_text(change)
        for left in reversed(range(_BIND_TRIES)):
            try:
                self._ask(request)
            except _PortTakenError:
                if not left:
                    raise
                time.sleep(LOOK_S)  # no event says that a port is free
            else:
                return

    def state(self) -> DeviceState:
        """Return the device's state."""
        return parse_state(self._ask("get=1\n\n"))

    def resume(self) -> None:
        """Ask a process again that did not respond: it was restarted."""
        self._silent_until_s = 0.0

    def _ask(self, request: str) -> list[tuple[str, str]]:
        """Return the lines of a reply without its last."""
        if time.monotonic() < self._silent_until_s:
            raise ControlLostError(f"tunnel {self._ifname}: wireguard-go did not respond")
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
                connection.settimeout(ANSWER_S)
                connection.connect(str(socket_path(self._ifname)))
                connection.sendall(request.encode())
                reply = _read(connection)
        except OSError as error:
            if isinstance(error, TimeoutError):
                self._silent_until_s = time.monotonic() + RETRY_S
            raise ControlLostError(f"tunnel {self._ifname}: wireguard-go does not respond: {error}") from error
        lines = [(key, value) for key, _, value in (line.partition("=") for line in reply.splitlines()) if key]
        if not lines or lines[-1][0] != "errno":
            raise ControlLostError(f"tunnel {self._ifname}: wireguard-go ended within a reply")
        number = abs(int(lines[-1][1]))
        if number == errno.EADDRINUSE:
            raise _PortTakenError(_in_use(self._ifname, request))
        if number:
            raise LocalError(f"tunnel {self._ifname}: wireguard-go refused a change: {os.strerror(number)}")
        return lines[:-1]


def request_text(change: Change) -> str:
    """Return the request for a change."""
    lines = ["set=1"]
    if change.fwmark is not None:
        lines.append(f"fwmark={change.fwmark}")
    if change.listen_port is not None:
        lines.append(f"listen_port={change.listen_port}")
    if change.private_key is not None:
        lines.append(f"private_key={change.private_key.hex()}")
    for peer in change.peers:
        lines += _peer_lines(peer)
    return "\n".join(lines) + "\n\n"


def parse_state(lines: Iterable[tuple[str, str]]) -> DeviceState:
    """Return the state in the reply to ``get=1``."""
    listen_port = 0
    peers: dict[bytes, PeerState] = {}
    key = b""
    for name, value in lines:
        if name == "listen_port":
            listen_port = int(value)
        elif name == "public_key":
            key = bytes.fromhex(value)
            peers[key] = PeerState(None, 0.0, 0, 0)
        elif key:
            peers[key] = _with(peers[key], name, value)
    return DeviceState(listen_port, peers)


def _with(peer: PeerState, name: str, value: str) -> PeerState:
    match name:
        case "endpoint":
            return peer._replace(endpoint=_endpoint(value))
        case "last_handshake_time_sec":
            return peer._replace(handshake_unix_s=float(value))
        case "last_handshake_time_nsec":  # it follows the seconds
            return peer._replace(handshake_unix_s=peer.handshake_unix_s + int(value) * _NANO)
        case "rx_bytes":
            return peer._replace(received_bytes=int(value))
        case "tx_bytes":
            return peer._replace(sent_bytes=int(value))
    return peer


def _peer_lines(peer: PeerChange) -> list[str]:
    lines = [f"public_key={peer.public_key.hex()}"]
    if peer.is_removed:
        return [*lines, "remove=true"]
    if peer.preshared_key:
        lines.append(f"preshared_key={peer.preshared_key.hex()}")
    if peer.endpoint is not None:
        lines.append(f"endpoint={peer.endpoint.to_text()}")
    if peer.keepalive_s is not None:
        lines.append(f"persistent_keepalive_interval={peer.keepalive_s}")
    if peer.inner:
        lines += ["replace_allowed_ips=true", f"allowed_ip={peer.inner}/128"]
    return lines


def _endpoint(text: str) -> Endpoint | None:
    try:
        return Endpoint.from_text(text)
    except LocalError:  # a form that a later version prints; the peer counts as unknown
        return None


def _read(connection: socket.socket) -> str:
    received = b""
    while not received.endswith(b"\n\n"):
        more = connection.recv(1 << 16)
        if not more or len(received) > _REPLY_MAX_BYTES:
            break
        received += more
    return received.decode(errors="replace")


def _in_use(ifname: str, request: str) -> str:
    port = next((line.partition("=")[2] for line in request.splitlines() if line.startswith("listen_port=")), "?")
    return f"tunnel {ifname}: UDP port {port} is in use; state another as links: listen, or end its user (ss -ulpn)"
