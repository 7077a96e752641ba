"""WireGuard of the kernel, configured through generic netlink.

I/O; pyroute2, imported only here because it is large. Source: ``include/uapi/linux/wireguard.h``.
"""

from __future__ import annotations

import errno
import os
from base64 import b64decode, b64encode
from collections.abc import Iterable
from typing import Any, Final

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.ports.sockets import AS_ROOT
from gdp.ports.tunnel.control import Change, DeviceState, PeerChange, PeerState

_NANO: Final = 1e-9


class KernelControl:
    """Control of a device of the kernel, as ``WireGuardControl``.

    Raises:
        LocalError: the kernel has no WireGuard.
    """

    def __init__(self, ifname: str) -> None:
        from pyroute2 import WireGuard
        from pyroute2.netlink.exceptions import NetlinkError

        self._ifname = ifname
        self._refusal = NetlinkError
        try:
            self._wireguard = WireGuard()
        except (NetlinkError, OSError) as error:
            raise LocalError(f"tunnel {ifname}: this kernel has no WireGuard ({error})") from error

    def apply(self, change: Change) -> None:
        """Change the device."""
        settings: dict[str, object] = {}
        if change.private_key is not None:
            settings["private_key"] = b64encode(change.private_key).decode()
        if change.listen_port is not None:
            settings["listen_port"] = change.listen_port
        if change.fwmark is not None:
            settings["fwmark"] = change.fwmark
        if settings:
            self._set(settings, change)
        for peer in change.peers:
            self._set({"peer": peer_arguments(peer)}, change)

    def state(self) -> DeviceState:
        """Return the device's state."""
        try:
            return parse_messages(self._wireguard.info(self._ifname))
        except self._refusal as error:
            raise LocalError(f"tunnel {self._ifname}: {self._text(error.code)}") from error

    def resume(self) -> None:
        """Do nothing: the kernel always responds."""

    def _set(self, settings: dict[str, object], change: Change) -> None:
        try:
            self._wireguard.set(self._ifname, **settings)
        except self._refusal as error:
            if error.code == errno.EADDRINUSE:
                raise LocalError(
                    f"tunnel {self._ifname}: UDP port {change.listen_port} is in use; state another as links: listen,"
                    " or end its user (ss -ulpn)"
                ) from error
            raise LocalError(f"tunnel {self._ifname}: WireGuard refused: {self._text(error.code)}") from error
        except OSError as error:  # an endpoint with a scope, which pyroute2 does not encode
            raise LocalError(f"tunnel {self._ifname}: WireGuard refused: {error}") from error

    @staticmethod
    def _text(number: int) -> str:
        return f"not permitted; {AS_ROOT}" if number == errno.EPERM else os.strerror(number)


def peer_arguments(peer: PeerChange) -> dict[str, object]:
    """Return a change of a peer as pyroute2's ``WireGuard.set`` takes it."""
    arguments: dict[str, object] = {"public_key": b64encode(peer.public_key).decode()}
    if peer.is_removed:
        return {**arguments, "remove": True}
    if peer.preshared_key:
        arguments["preshared_key"] = b64encode(peer.preshared_key).decode()
    if peer.endpoint is not None:
        arguments |= {"endpoint_addr": peer.endpoint.address, "endpoint_port": peer.endpoint.port}
    if peer.keepalive_s is not None:
        arguments["persistent_keepalive"] = peer.keepalive_s
    if peer.inner:
        arguments |= {"replace_allowed_ips": True, "allowed_ips": [f"{peer.inner}/128"]}
    return arguments


def parse_messages(messages: Iterable[Any]) -> DeviceState:
    """Return the state in the dump of a device; a device with many peers takes several messages."""
    listen_port = 0
    peers: dict[bytes, PeerState] = {}
    for message in messages:
        listen_port = message.get_attr("WGDEVICE_A_LISTEN_PORT") or listen_port
        for peer in message.get_attr("WGDEVICE_A_PEERS") or ():
            key = b64decode(peer.get_attr("WGPEER_A_PUBLIC_KEY"))
            endpoint = peer.get_attr("WGPEER_A_ENDPOINT")
            handshake = peer.get_attr("WGPEER_A_LAST_HANDSHAKE_TIME") or {"tv_sec": 0, "tv_nsec": 0}
            peers[key] = PeerState(
                endpoint=None if endpoint is None else Endpoint(endpoint["addr"], endpoint["port"]),
                handshake_unix_s=handshake["tv_sec"] + handshake["tv_nsec"] * _NANO,
                received_bytes=peer.get_attr("WGPEER_A_RX_BYTES") or 0,
                sent_bytes=peer.get_attr("WGPEER_A_TX_BYTES") or 0,
            )
    return DeviceState(listen_port, peers)
