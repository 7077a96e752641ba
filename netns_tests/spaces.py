"""Unnamed network namespace of this thread; the kernel removes it with its last socket, however the test ends."""

from __future__ import annotations

import ctypes
import os
import select
import subprocess
from pathlib import Path

from gdp.ports.rtnetlink import LinkMonitor

_PATIENCE_S = 10.0
_CLONE_NEWNET = 0x40000000
_LIBRARY = ctypes.CDLL(None, use_errno=True)


def _call(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def enter_namespace(descriptor: int) -> None:
    """Move this thread into the network namespace of an open descriptor.

    Raises:
        OSError: not allowed here.
    """
    _call(_LIBRARY.setns(descriptor, _CLONE_NEWNET))


class Space:
    """Entering moves the thread (and the processes it starts) into a new namespace; leaving moves it back.

    Raises:
        OSError: not allowed here.
    """

    def __enter__(self) -> Space:
        self._before = os.open("/proc/self/ns/net", os.O_RDONLY)
        try:
            _call(_LIBRARY.unshare(_CLONE_NEWNET))
        except OSError:
            os.close(self._before)
            raise
        Path("/proc/sys/net/ipv6/conf/default/disable_ipv6").write_text("1")  # no frames but ours
        return self

    def __exit__(self, *_: object) -> None:
        enter_namespace(self._before)
        os.close(self._before)

    def ip(self, *words: str) -> None:
        """Run ``ip link`` here.

        Raises:
            subprocess.CalledProcessError: it refused.
        """
        subprocess.run(["ip", "link", *words], check=True, capture_output=True, text=True)

    def veth(self, one: str, other: str, one_mac: bytes, other_mac: bytes, mtu: int = 1500) -> None:
        """Create a pair of joined devices; return when both are up."""
        ends = ("mtu", str(mtu), "address", one_mac.hex(":")), ("mtu", str(mtu), "address", other_mac.hex(":"))
        self.ip("add", one, *ends[0], "type", "veth", "peer", "name", other, *ends[1])
        for name in (one, other):
            self.ip("set", name, "up")
        self.ready(one, other)

    def ready(self, *names: str) -> None:
        """Return when the kernel reports that these devices can send.

        Raises:
            TimeoutError: they did not come up.
        """
        watch = LinkMonitor()
        try:
            while not all(link and link.up for link in map(watch.get, names)):
                if not select.select([watch], [], [], _PATIENCE_S)[0]:
                    raise TimeoutError(f"{names} did not come up")
                watch.poll()
        finally:
            watch.close()
