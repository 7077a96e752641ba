"""Unnamed network namespace of this thread; the kernel removes it with its last socket, however the test ends."""

from __future__ import annotations

import ctypes
import os
import subprocess
from pathlib import Path

from pyroute2 import netns

from lab.namespaces import wait_for_carrier

_LIBRARY = ctypes.CDLL(None, use_errno=True)


class Space:
    """Entering moves the thread (and the processes it starts) into a new namespace; leaving moves it back.

    Raises ``OSError``: not allowed here.
    """

    def __enter__(self) -> Space:
        self._before = os.open("/proc/self/ns/net", os.O_RDONLY)
        if _LIBRARY.unshare(netns.CLONE_NEWNET):
            os.close(self._before)
            raise OSError(number := ctypes.get_errno(), os.strerror(number))
        Path("/proc/sys/net/ipv6/conf/default/disable_ipv6").write_text("1")  # no frames but ours
        return self

    def __exit__(self, *_: object) -> None:
        netns.setns(self._before)
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
        wait_for_carrier(one, other)
