"""Listening TCP socket, of one address or of all, and the networks by which a server counts connections.

I/O. Sources: ipv6(7), ``IPV6_V6ONLY``; RFC 4291, section 2.5.1: a subnet of IPv6 has 64 bits, so its owner has any
number of addresses.
"""

from __future__ import annotations

import ipaddress
import socket
from typing import Final

_BACKLOG: Final = 128
_SUBNET_BYTES: Final = 8


def listen_tcp(host: str, port: int) -> socket.socket:
    """Return a listening socket; an empty host: all addresses, IPv4 and IPv6 at one socket where the host can.

    Raises:
        OSError: the port is in use or needs a right, or the address is not this host's.
    """
    if not host and socket.has_dualstack_ipv6():
        return socket.create_server(("", port), family=socket.AF_INET6, backlog=_BACKLOG, dualstack_ipv6=True)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=_BACKLOG)


def client_network(host: str) -> bytes:
    """Return what counts as one client: an IPv4 address, also one in an IPv6 form, or the /64 of an IPv6 address.

    Args:
        host: numeric, as ``accept`` returns it; a zone may follow.
    """
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv4Address):
        return address.packed
    mapped = address.ipv4_mapped
    return address.packed[:_SUBNET_BYTES] if mapped is None else mapped.packed
