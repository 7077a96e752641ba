"""WireGuard device of a switch: of the kernel, or of a ``wireguard-go`` process that a keeper runs.

I/O. A device is opened before the switch confines itself. Afterwards peers still come and go, because that needs only
CAP_NET_ADMIN and the control socket. The object stores what it was given: after a restart of ``wireguard-go`` it
applies the key, the port and the peers again, and each peer then starts a handshake.

A session survives a change of this end's address: when the route to a peer changes, the device forgets its cached
source addresses and sends a keepalive at once, from which the peer learns the new address.
"""

from __future__ import annotations

import logging
import select
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.ports.netlink import ADDRESS_GROUPS, LINK_GROUP, ROUTE_GROUPS, Notifications, RefusedError
from gdp.ports.tunnel.control import (
    Change,
    ControlLostError,
    PeerChange,
    PeerState,
    WireGuardControl,
)
from gdp.ports.tunnel.devices import (
    Device,
    add_address,
    add_route,
    find_device,
    make_up,
    refusal_text,
    remove_route,
    set_mtu,
)
from gdp.ports.tunnel.keeper_process import KeeperProcess
from gdp.ports.tunnel.kernel_control import KernelControl
from gdp.ports.tunnel.path_mtu import RouteMonitor
from gdp.ports.tunnel.uapi import UserspaceControl
from gdp.ports.tunnel.uplink_routes import mark_of

log = logging.getLogger(__name__)

Backend = Literal["auto", "kernel", "wireguard-go"]
_SILENT_S: Final = 2.0  # a neighbour sends hellos more often than this
_SESSION_S: Final = 180.0  # REJECT_AFTER_TIME: WireGuard paper, section 6.1


@dataclass(frozen=True, slots=True)
class _Peer:
    """A peer as it was given, with the endpoint that the device uses."""

    inner: str
    endpoint: Endpoint | None
    keepalive_s: int
    preshared_key: bytes = field(default=b"", repr=False)  # empty: never set


class WireGuardDevice:
    """A WireGuard device with one inner address; ``open_wireguard`` makes it. For one thread.

    Attributes:
        ifname: name of the device.
        backend: ``kernel`` or ``wireguard-go``.
        reason: why the device is not the kernel's; empty if it is.
        fwmark: mark of its outer packets, by which ``route_mtu`` finds their route; 0: none.
    """

    def __init__(
        self,
        *,
        ifname: str,
        private_key: bytes,
        listen_port: int,
        inner: str,
        mtu: int,
        keeper: KeeperProcess,
        control: WireGuardControl,
        fwmark: int,
    ) -> None:
        self.ifname = ifname
        self.backend = keeper.ready.backend
        self.reason = keeper.ready.text
        self._private_key = private_key
        self._port = listen_port
        self._inner = inner
        self._mtu = mtu
        self._keeper = keeper
        self._control = control
        self.fwmark = fwmark
        self._peers: dict[bytes, _Peer] = {}
        self._states: dict[bytes, PeerState] = {}
        self._has_moved = False  # not polled yet
        self._has_waiting = False  # changes that wireguard-go did not get
        self._heard: dict[
            bytes, tuple[int, float]
        ] = {}  # bytes received, and the monotonic second of their last change
        with ExitStack() as opened:
            self._routes = RouteMonitor(fwmark)
            opened.callback(self._routes.close)
            self._news = opened.enter_context(closing(Notifications(LINK_GROUP | ADDRESS_GROUPS | ROUTE_GROUPS)))
            self._epoll = opened.enter_context(select.epoll())
            self._epoll.register(keeper, select.EPOLLIN)
            self._epoll.register(self._news, select.EPOLLIN)
            self._configure()
            self._port = self._first_port = self._control.state().listen_port
            opened.pop_all()

    @property
    def listen_port(self) -> int:
        """Return the UDP port; only ``rebind`` changes it."""
        return self._port

    @property
    def is_lost(self) -> bool:
        """Return whether the keeper was killed: the device does not work until the switch starts again."""
        return self._keeper.is_lost

    def set_peer(self, public_key: bytes, *, inner: str, endpoint: Endpoint | None, keepalive_s: int) -> None:
        """Add or update a peer, and lead its inner address through this device.

        Args:
            public_key: 32 bytes.
            inner: the peer's inner address, the only one that it may use.
            endpoint: where to send; None leaves the present one, learnt or not.
            keepalive_s: seconds between keepalives, 0 to 65,535; 0: none.

        Raises:
            LocalError: the device refuses.
        """
        before = self._peers.get(public_key)
        known = endpoint or (None if before is None else self._endpoint(public_key))
        self._peers[public_key] = _Peer(inner, known, keepalive_s, b"" if before is None else before.preshared_key)
        change = PeerChange(public_key=public_key, inner=inner, endpoint=endpoint, keepalive_s=keepalive_s)
        try:
            self._apply(Change(peers=(change,)))
        except LocalError:
            del self._peers[public_key]
            if before is not None:
                self._peers[public_key] = before
            raise
        if before is not None and before.inner != inner:
            self._with_device(lambda device: remove_route(device.ifindex, before.inner))
        self._with_device(lambda device: add_route(device.ifindex, inner))
        if known is not None:
            self._routes.watch(known)

    def set_preshared_key(self, public_key: bytes, preshared_key: bytes) -> bool:
        """Set the preshared key of a peer, from its next handshake on; return whether it had another.

        Args:
            preshared_key: 32 bytes; zeros: none.

        Raises:
            LocalError: the device refuses.
        """
        peer = self._peers.get(public_key)
        if peer is None or (peer.preshared_key or bytes(len(preshared_key))) == preshared_key:
            return False
        self._peers[public_key] = replace(peer, preshared_key=preshared_key)
        self._apply(Change(peers=(PeerChange(public_key=public_key, preshared_key=preshared_key),)))
        return True

    def remove_peer(self, public_key: bytes) -> None:
        """Remove a peer with its session and its route; does nothing if there is none."""
        peer = self._peers.pop(public_key, None)
        self._states.pop(public_key, None)
        self._heard.pop(public_key, None)
        if peer is not None:
            self._apply(Change(peers=(PeerChange(public_key=public_key, is_removed=True),)))
            if all(other.inner != peer.inner for other in self._peers.values()):
                self._with_device(lambda device: remove_route(device.ifindex, peer.inner))

    def retry_handshake(self, public_key: bytes) -> None:
        """Send to a peer at once: a handshake, or a keepalive if its session works; does nothing without a peer.

        A device limits itself to one handshake in five seconds for each peer, and believes in a session for 15 seconds
        after the other end lost it. A peer without a session, or silent for two seconds, is therefore made again.
        """
        peer = self._peers.get(public_key)
        if peer is None:
            return
        state = self.peers()[public_key]
        is_silent = time.monotonic() - self._heard[public_key][1] > _SILENT_S
        if is_silent or time.time() - state.handshake_unix_s > _SESSION_S:
            removed = PeerChange(public_key=public_key, is_removed=True)
            self._apply(Change(peers=(removed, *self._restored(public_key))))
        else:
            self._apply(Change(peers=_kicked(public_key, peer.keepalive_s)))

    def rebind(self) -> None:
        """Send from another UDP port from now on, so that NATs on the way make new mappings; sessions stay.

        Each second time it is the first port, unless it is taken: peers know the mapping that most NATs make for it.
        """
        try:
            self._apply(Change(listen_port=0 if self._port == self._first_port else self._first_port))
        except LocalError:
            self._apply(Change(listen_port=0))
        try:
            self._port = self._control.state().listen_port
        except ControlLostError:
            self._port = 0  # any: wireguard-go is starting again
        kicks = [kick for key, peer in self._peers.items() for kick in _kicked(key, peer.keepalive_s)]
        self._apply(Change(peers=tuple(kicks)))

    def peers(self) -> dict[bytes, PeerState]:
        """Return the state of every peer by public key; while the device restarts, without handshakes."""
        try:
            found = self._control.state().peers
        except ControlLostError:
            found = {key: state._replace(handshake_unix_s=0.0) for key, state in self._states.items()}
        unknown = PeerState(None, 0.0, 0, 0)  # of a process that was restarted and has no peers yet
        states = {key: found.get(key, unknown) for key in self._peers}
        self._states = {
            key: state if state.endpoint is not None else state._replace(endpoint=self._endpoint(key))
            for key, state in states.items()
        }
        now_s = time.monotonic()
        for key, state in self._states.items():
            if key not in self._heard or self._heard[key][0] != state.received_bytes:
                self._heard[key] = state.received_bytes, now_s
        return dict(self._states)

    def known_peers(self) -> dict[bytes, PeerState]:
        """Return the state of every peer at the last ``peers`` or ``poll``; costs nothing."""
        return dict(self._states)

    def poll_move(self) -> bool:
        """Return, once, whether the address of this end, or the uplink, has changed."""
        has_moved, self._has_moved = self._has_moved, False
        return has_moved

    def path_mtu(self, public_key: bytes) -> int | None:
        """Return the MTU of the path to a peer's endpoint in bytes, as of the last ``poll``; None: not known now.

        ``tunnel_mtu`` translates it to the MTUs inside.
        """
        peer = self._peers.get(public_key)
        endpoint = None if peer is None else self._endpoint(public_key)
        route = None if endpoint is None else self._routes.route(endpoint)
        return None if route is None else route.mtu

    def set_mtu(self, mtu: int) -> None:
        """Set the MTU of the device in bytes, at least 1280. Raises ``LocalError``: the kernel refuses."""
        self._mtu = mtu
        self._with_device(lambda device: None if device.mtu == mtu else set_mtu(device.ifindex, mtu))

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``handle_events`` has work."""
        return self._epoll.fileno()

    def handle_events(self) -> bool:
        """Handle restarts of ``wireguard-go`` and changes of addresses and routes, without waiting.

        Returns:
            Whether the device was made again. VXLAN devices on it are gone then, and must be made again.
        """
        is_new = False
        for report in self._keeper.reports():
            if report.event == "restarted":
                log.warning("wireguard-go was restarted ifname=%s", self.ifname)
                is_new = is_new or not report.is_same
                self._control.resume()
                self._configure_again()
            elif report.event == "lost":
                self._epoll.unregister(self._keeper)
                log.error("the keeper of a tunnel device died: start the switch again ifname=%s", self.ifname)
            elif report.event == "warning":
                log.warning("tunnel device ifname=%s: %s", self.ifname, report.text)
            else:
                log.warning("wireguard-go ended ifname=%s reason=%s", self.ifname, report.text)
        if self._news.has_news():
            self.peers()
            self._follow_routes()
        return is_new

    def poll(self) -> bool:
        """Look at what no event reports: learnt endpoints and path MTUs.

        Call it each second. Returns as ``handle_events``.
        """
        if self._has_waiting:
            self._configure_again()
        self.peers()
        self._follow_routes()
        return self.handle_events()

    def close(self) -> None:
        """Remove the device with everything on it, and end its processes."""
        self._epoll.close()
        self._news.close()
        self._routes.close()
        self._keeper.close()

    # configuration

    def _configure(self) -> None:
        """Apply everything that was given. Raises ``LocalError``: the device refuses."""
        self._with_device(self._prepare)
        gone = self._control.state().peers.keys() - self._peers.keys()
        removed = [PeerChange(public_key=key, is_removed=True) for key in gone]
        peers = (*removed, *(change for key in self._peers for change in self._restored(key)))
        self._control.apply(
            Change(private_key=self._private_key, listen_port=self._port, fwmark=self.fwmark, peers=peers)
        )

    def _configure_again(self) -> None:
        try:
            self._configure()
            self._has_waiting = False
        except ControlLostError:
            self._has_waiting = True
        except LocalError as error:  # its port was taken meanwhile
            log.error("tunnel device not configured ifname=%s reason=%s", self.ifname, error)

    def _prepare(self, device: Device) -> None:
        if device.mtu != self._mtu:
            set_mtu(device.ifindex, self._mtu)
        make_up(device.ifindex)
        add_address(device.ifindex, self._inner)
        for peer in self._peers.values():
            add_route(device.ifindex, peer.inner)

    def _restored(self, public_key: bytes) -> tuple[PeerChange, ...]:
        """Return the changes that make a peer and let it start a handshake."""
        peer = self._peers[public_key]
        made = PeerChange(
            public_key=public_key,
            inner=peer.inner,
            endpoint=self._endpoint(public_key),
            keepalive_s=peer.keepalive_s,
            preshared_key=peer.preshared_key,
        )
        return (made,) if peer.keepalive_s else (made, *_kicked(public_key, 0))

    def _endpoint(self, public_key: bytes) -> Endpoint | None:
        """Return the endpoint that the device last used, else the one that was given."""
        state = self._states.get(public_key)
        return state.endpoint if state is not None and state.endpoint is not None else self._peers[public_key].endpoint

    def _apply(self, change: Change) -> None:
        try:
            self._control.apply(change)
        except ControlLostError:  # applied with everything else once wireguard-go is back
            self._has_waiting = True
            log.info("change waits for wireguard-go ifname=%s", self.ifname)

    def _with_device(self, act: Callable[[Device], None]) -> None:
        """Act on the device, if it exists: a new one gets everything."""
        device = find_device(self.ifname)
        if device is None:
            return
        try:
            act(device)
        except RefusedError as error:
            raise LocalError(f"tunnel {self.ifname}: {refusal_text(error)}") from error

    # roaming

    def _follow_routes(self) -> None:
        """Let the device use its present addresses, if the route to a peer changed."""
        endpoints = [endpoint for key in self._peers if (endpoint := self._endpoint(key)) is not None]
        changes = self._routes.poll(endpoints).values()
        if any(now is not None and (before is None or before[:3] != now[:3]) for before, now in changes):
            log.info("address or uplink changed ifname=%s", self.ifname)
            self._has_moved = True
            kicks = [kick for key, peer in self._peers.items() for kick in _kicked(key, peer.keepalive_s)]
            self._apply(Change(listen_port=self._port, peers=tuple(kicks)))


def open_wireguard(
    *,
    ifname: str,
    private_key: bytes,
    listen_port: int,
    inner: str,
    mtu: int,
    alias: str,
    backend: Backend = "auto",
    uplink: str = "",
) -> WireGuardDevice:
    """Make a WireGuard device and switch it on; one that a dead run of this switch left is replaced.

    Args:
        ifname: unique on the host, also across network namespaces.
        private_key: 32 bytes.
        listen_port: UDP port; 0: any.
        inner: inner IPv6 address of this end.
        mtu: in bytes, at least 1280.
        alias: identifies the devices of this switch.
        uplink: device that outer packets leave by; they have a mark of their own then. Empty: routing decides.

    Raises:
        LocalError: there is no WireGuard of either kind, the port is taken, a foreign device has this name, or this
            user lacks the rights. Nothing is left then.
    """
    keeper = KeeperProcess(ifname, alias, backend, uplink)
    try:
        control: WireGuardControl = (
            KernelControl(ifname) if keeper.ready.backend == "kernel" else UserspaceControl(ifname)
        )
        return WireGuardDevice(
            ifname=ifname,
            private_key=private_key,
            listen_port=listen_port,
            inner=inner,
            mtu=mtu,
            keeper=keeper,
            control=control,
            fwmark=mark_of(ifname) if uplink else 0,
        )
    except BaseException:
        keeper.close()
        raise


def _kicked(public_key: bytes, keepalive_s: int) -> tuple[PeerChange, ...]:
    """Return the changes after which the device sends to a peer at once, and the keepalive is as before."""
    values = (0, keepalive_s) if keepalive_s else (1, 0)
    return tuple(PeerChange(public_key=public_key, keepalive_s=value) for value in values)
