"""Address monitor: reports that addresses or routes of this namespace have changed, and which address leads to a peer.

I/O; a NETLINK_ROUTE socket. Source: rtnetlink(7).
"""

from __future__ import annotations

import errno
import socket
from typing import Final

from gdp.ports.netlink import ADDRESS_GROUPS, LINK_GROUP, READ_BYTES, listen

__all__ = ["AddressMonitor", "source_address"]

_DISCARD_PORT: Final = 9  # any would do: connecting a UDP socket sends nothing


class AddressMonitor:
    """Notifications of changed addresses, routes and devices. Raises ``LocalError``: the kernel has no such sockets."""

    def __init__(self) -> None:
        self._news = listen(ADDRESS_GROUPS | LINK_GROUP)

    def fileno(self) -> int:
        """Return the descriptor to wait on; readable when something has changed."""
        return self._news.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._news.close()

    def poll(self) -> bool:
        """Read all notifications; return whether there was one. Skipped ones count as one."""
        has_changed = False
        while True:
            try:
                self._news.recv(READ_BYTES)
            except BlockingIOError:
                return has_changed
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
            has_changed = True


def source_address(peer: str) -> str | None:
    """Return the local address from which the kernel now reaches a numeric address; None: there is no route."""
    family = socket.AF_INET6 if ":" in peer else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as probe:
        try:
            probe.connect((peer, _DISCARD_PORT))
        except OSError:
            return None
        return str(probe.getsockname()[0])
