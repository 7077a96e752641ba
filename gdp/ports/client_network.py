"""Network of a client, by which a server counts connections.

I/O layer, without I/O of its own. Source: RFC 4291, section 2.5.1: a subnet of IPv6 has 64 bits, so its owner has
any number of addresses.
"""

from __future__ import annotations

import ipaddress
from typing import Final

__all__ = ["client_network"]

_SUBNET_BYTES: Final = 8


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
