"""Listening TCP socket, of one address or of all. I/O. Source: ipv6(7), ``IPV6_V6ONLY``."""

from __future__ import annotations

import socket
from typing import Final

__all__ = ["listen_tcp"]

_BACKLOG: Final = 128


def listen_tcp(host: str, port: int) -> socket.socket:
    """Return a listening socket; an empty host: all addresses, IPv4 and IPv6 at one socket where the host can.

    Raises:
        OSError: the port is in use or needs a right, or the address is not this host's.
    """
    if not host and socket.has_dualstack_ipv6():
        return socket.create_server(("", port), family=socket.AF_INET6, backlog=_BACKLOG, dualstack_ipv6=True)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=_BACKLOG)
