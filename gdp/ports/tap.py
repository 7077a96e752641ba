"""TAP device: frames of a switch's port through a file descriptor, for the relay.

I/O. Source: Documentation/networking/tuntap.rst. The device is not persistent: the kernel removes it with its
descriptor, however the process ends. It has a carrier only while the relay's connection is open, so that the switch
treats the port as down at once.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from gdp.errors import LocalError
from gdp.names import Name
from gdp.ports.netlink import LinkAttribute, RefusedError
from gdp.ports.sockets import AS_ROOT
from gdp.ports.tunnel.devices import bring_up, refusal_text, set_mtu

_TUN: Final = "/dev/net/tun"
_TUNSETIFF: Final = 0x400454CA
_TUNSETCARRIER: Final = 0x400454E2  # Linux 5.0
_IFF_TAP: Final = 0x0002
_IFF_NO_PI: Final = 0x1000
_IFF_TUN_EXCL: Final = 0x8000  # never join a device that exists
_IFREQ: Final = struct.Struct("16sH22x")
_FLAG: Final = struct.Struct("=i")
_PREFIX: Final = "gr"
_DIGEST_BYTES: Final = 6
_QUEUE_FRAMES: Final = 512  # in the kernel, for a burst; the relay reads it always and bounds its own queue


def tap_name(own: Name, peer: Name) -> str:
    """Return the device of switch ``own`` for its relay connection with ``peer``; unique on a host by its hash."""
    return _PREFIX + hashlib.sha256(b"gdp-relay-tap-1" + own + peer).digest()[:_DIGEST_BYTES].hex()


def relay_alias(own: Name) -> str:
    """Return the alias that marks devices of the relay of switch ``own``."""
    return f"gdp-relay {own.to_text()}"


class TapDevice:
    """One TAP device, up and without a carrier; reads and writes never block.

    Args:
        ifname: of the new device.
        alias: text that states its owner.
        mtu: bytes after the Ethernet header.

    Raises:
        LocalError: no such driver, no right to it, or a device of this name exists.
    """

    def __init__(self, ifname: str, alias: str, mtu: int) -> None:
        self.ifname = ifname
        self._has_carrier = True
        self._fd = _open(ifname)
        try:
            self.set_carrier(on=False)
            with self._configuring():
                numbers = (LinkAttribute.MTU, mtu), (LinkAttribute.TXQLEN, _QUEUE_FRAMES)
                self._ifindex = bring_up(ifname, alias, *numbers)
        except BaseException:
            self.close()
            raise
        self._mtu = mtu

    def fileno(self) -> int:
        """Return the descriptor to wait on; readable when the host has sent a frame."""
        return self._fd

    def close(self) -> None:
        """Remove the device."""
        os.close(self._fd)

    def read(self) -> bytes:
        """Return the next frame of the host. Raises ``OSError``, such as ``BlockingIOError``: there is none."""
        return os.read(self._fd, self._mtu + 64)

    def write(self, frame: bytes | memoryview) -> bool:
        """Pass a frame to the host; return whether the device took it."""
        try:
            os.write(self._fd, frame)
        except OSError:
            return False
        return True

    def set_carrier(self, *, on: bool) -> None:
        """Switch the carrier on or off. Raises ``LocalError``: the system refuses."""
        if on is self._has_carrier:
            return
        try:
            fcntl.ioctl(self._fd, _TUNSETCARRIER, _FLAG.pack(on))
        except OSError as error:
            raise LocalError(f"{self.ifname}: the carrier of the TAP device cannot be set: {error.strerror}") from error
        self._has_carrier = on

    def set_mtu(self, mtu: int) -> None:
        """Change the MTU. Raises ``LocalError``: the system refuses."""
        if mtu != self._mtu:
            with self._configuring():
                set_mtu(self._ifindex, mtu)
            self._mtu = mtu

    @contextmanager
    def _configuring(self) -> Iterator[None]:
        try:
            yield
        except RefusedError as error:
            raise LocalError(f"{self.ifname}: the TAP device cannot be configured: {refusal_text(error)}") from error


def _open(ifname: str) -> int:
    try:
        opened = os.open(_TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            raise LocalError(
                f"{_TUN}: there is no TUN/TAP driver; load it (modprobe tun), or give the container this device"
            ) from error
        raise LocalError(f"{_TUN}: {error.strerror}; {AS_ROOT}") from error
    try:
        fcntl.ioctl(opened, _TUNSETIFF, _IFREQ.pack(ifname.encode(), _IFF_TAP | _IFF_NO_PI | _IFF_TUN_EXCL))
    except OSError as error:
        os.close(opened)
        if error.errno in (errno.EBUSY, errno.EEXIST, errno.EINVAL):
            raise LocalError(
                f"{ifname}: a device of this name exists; another relay may run with this identity"
            ) from error
        raise LocalError(f"{ifname}: the TAP device cannot be made: {error.strerror}; {AS_ROOT}") from error
    return opened
