"""Two sites joined by a cable ``u0``, each with a WireGuard device, and a VXLAN link between them."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable, Iterator

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from gdp.control.endpoints import Endpoint
from gdp.ports.tunnel.devices import find_device
from gdp.ports.tunnel.vxlan import make_vxlan
from gdp.ports.tunnel.wireguard import WireGuardDevice, open_wireguard
from lab import process
from lab.namespaces import Space

PATIENCE_S = 30.0
POLL_S = 1.0
PORT = 51820
VNI = 77
ETHERTYPE = 0x88B5


class Site:
    """A namespace with the end of the cable and a tunnel device of its own; ``space``: an existing namespace."""

    def __init__(self, number: int, tag: str, space: Space | None = None) -> None:
        key = X25519PrivateKey.generate()
        self.private_key, self.public_key = key.private_bytes_raw(), key.public_key().public_bytes_raw()
        self.address, self.inner = f"10.9.0.{number}", f"fd00::{number}"
        self.ifname, self.link = f"w{tag}{number}", f"x{tag}{number}"
        self.alias = f"gdp-switch {bytes([number]).hex() * 32}"
        self.endpoint = Endpoint(self.address, PORT)
        self._stack = contextlib.ExitStack()
        self.space = space or self._stack.enter_context(contextlib.closing(Space()))
        self.entered, self.ip = self.space.entered, self.space.ip

    def open(self, listen_port: int = PORT, ifname: str = "", uplink: str = "") -> WireGuardDevice:
        """Open a WireGuard device."""
        with self.entered():
            device = open_wireguard(
                ifname=ifname or self.ifname,
                private_key=self.private_key,
                listen_port=listen_port,
                inner=self.inner,
                mtu=1440,
                alias=self.alias,
                backend="wireguard-go",
                uplink=uplink,
            )
        self._stack.callback(device.close)
        return device

    def connect(self, device: WireGuardDevice, other: Site, *, is_dialling: bool) -> None:
        """Add the other site as a peer, and make the VXLAN link to it."""
        endpoint = other.endpoint if is_dialling else None
        with self.entered():
            device.set_peer(other.public_key, inner=other.inner, endpoint=endpoint, keepalive_s=25)
            self.make_link(device.ifname, other)

    def make_link(self, underlay: str, other: Site) -> None:
        """Make the VXLAN link."""
        make_vxlan(
            ifname=self.link,
            vni=VNI,
            local=self.inner,
            remote=other.inner,
            underlay=underlay,
            mtu=1370,
            alias=self.alias,
        )

    def frames(self) -> socket.socket:
        """Return a socket for our frames on the VXLAN link; it does not block."""
        with self.entered():
            opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE))
            opened.bind((self.link, ETHERTYPE))
        opened.setblocking(False)
        self._stack.callback(opened.close)
        return opened

    def has(self, ifname: str) -> bool:
        """Return whether there is a device of this name."""
        with self.entered():
            return find_device(ifname) is not None

    def close(self) -> None:
        """Close the device and leave the namespace to the kernel."""
        self._stack.close()


@contextlib.contextmanager
def two_sites() -> Iterator[tuple[Site, Site]]:
    """Make two sites that reach each other over ``u0``."""
    tag = os.urandom(3).hex()
    one, two = Site(1, tag), Site(2, tag)
    try:
        one.space.connect(two.space, "u0")
        for site in (one, two):
            site.ip("link", "set", "lo", "up")
            site.space.set("ipv4/conf/u0/promote_secondaries", "1")
            site.ip("address", "add", f"{site.address}/24", "dev", "u0")
        yield one, two
    finally:
        two.close()
        one.close()


def until(is_true: Callable[[], bool], *devices: WireGuardDevice) -> None:
    """Serve these devices, as a switch does, until this is true."""
    poll_s = time.monotonic() + POLL_S

    def serve() -> None:
        nonlocal poll_s
        if time.monotonic() > poll_s:
            poll_s += POLL_S
            for device in devices:
                device.poll()
        ready, _, _ = select.select(devices, [], [], 0.01)
        for device in ready:
            device.handle_events()

    process.until(is_true, patience_s=PATIENCE_S, meanwhile=serve)


def payload(number: int) -> bytes:
    """Return a frame with a number."""
    return (
        b"\xff" * 6 + bytes([2, 0, 0, 0, 0, 1]) + ETHERTYPE.to_bytes(2, "big") + number.to_bytes(4, "big") + bytes(60)
    )


def numbers(receiver: socket.socket) -> list[int]:
    """Return the numbers of the frames that wait."""
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(int.from_bytes(receiver.recv(2_000)[14:18], "big"))
    return found


def crosses(sender: socket.socket, receiver: socket.socket) -> Callable[[], bool]:
    """Return a function that sends a frame, and returns whether one arrived since the first call."""
    numbers(receiver)

    def has_crossed() -> bool:
        """Send one more frame."""
        sender.send(payload(0))
        return bool(numbers(receiver))

    return has_crossed
