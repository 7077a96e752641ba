"""MTU of the path to a tunnel's endpoint, and the MTUs that it leaves inside the tunnel.

I/O. Source: ``RTM_GETROUTE`` of rtnetlink(7). The kernel caches the path MTU that routers report (RFC 1191, RFC 8201);
no notification follows such a change, so a node looks once a second.
"""

from __future__ import annotations

import ipaddress
import socket
import sys
from collections.abc import Iterable
from contextlib import closing
from typing import Final, NamedTuple

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.ports.netlink import NUMBER, ROUTE, LinkAttribute, NetlinkSocket, RefusedError, Rtm, attribute, nested

_IPV4_BYTES: Final = 20  # RFC 791, section 3.1
_IPV6_BYTES: Final = 40  # RFC 8200, section 3
_UDP_BYTES: Final = 8  # RFC 768
_DATA_BYTES: Final = 32  # WireGuard paper, section 5.4.6: type and reserved 4, receiver 4, counter 8, tag 16
_PADDED_BYTES: Final = 16  # the same section: the plaintext is padded to a multiple of this
_VXLAN_BYTES: Final = 8  # RFC 7348, section 5
_ETHERNET_BYTES: Final = 14
_INNER_BYTES: Final = _IPV6_BYTES + _UDP_BYTES + _VXLAN_BYTES + _ETHERNET_BYTES
_IPV6_MTU_MIN: Final = 1280  # RFC 8200, section 5: below it, Linux removes IPv6 from a device
_OUTER_MTU_MAX: Final = 9_000  # jumbo frames; the loopback device has 65,536

_RTA_DST, _RTA_OIF, _RTA_GATEWAY, _RTA_PREFSRC, _RTA_METRICS, _RTA_MARK = 1, 4, 5, 7, 8, 16
_RTAX_MTU: Final = 2


class Route(NamedTuple):
    """Route to an endpoint, as the kernel would take it now.

    Attributes:
        ifindex: of the device that packets leave by.
        source: their source address, packed.
        gateway: the next router, packed; empty on the own link.
        mtu: path MTU in bytes, including the IP header.
    """

    ifindex: int
    source: bytes
    gateway: bytes
    mtu: int


def route_to(netlink: NetlinkSocket, endpoint: Endpoint, fwmark: int = 0) -> Route | None:
    """Return the route to an endpoint; None if there is none now."""
    address = ipaddress.ip_address(endpoint.address)
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    body = ROUTE.pack(family, address.max_prefixlen, 0, 0, 0, 0, 0, 0, 0) + attribute(_RTA_DST, address.packed)
    if fwmark:
        body += attribute(_RTA_MARK, NUMBER.pack(fwmark))
    if isinstance(address, ipaddress.IPv6Address) and address.scope_id:
        try:
            body += attribute(_RTA_OIF, NUMBER.pack(socket.if_nametoindex(address.scope_id)))
        except OSError:
            return None
    try:
        replies = netlink.question(Rtm.GETROUTE, body)
    except RefusedError:  # unreachable, prohibited, or no such network
        return None
    for reply in replies:
        if reply.kind == Rtm.NEWROUTE:
            return _route(netlink, nested(reply.body[ROUTE.size :]))
    return None


def route_mtu(endpoint: Endpoint, fwmark: int = 0) -> int:
    """Return the path MTU to an endpoint in bytes, as the kernel knows it: cached, of the route, or of the device.

    Args:
        fwmark: mark of the packets, which rules of routing may select; 0: none.

    Raises:
        LocalError: there is no route to the endpoint.
    """
    with closing(NetlinkSocket()) as netlink:
        route = route_to(netlink, endpoint, fwmark)
    if route is None:
        raise LocalError(f"no route to {endpoint.to_text()}")
    return route.mtu


def tunnel_mtu(outer_mtu: int, is_ipv6: bool) -> tuple[int, int]:
    """Return the MTUs of the WireGuard device and of a VXLAN device in it, so that no packet is fragmented.

    Args:
        outer_mtu: of the path, including the IP header.
        is_ipv6: whether the endpoint has an IPv6 address.

    Returns:
        The WireGuard MTU, at least 1280 (its inner addresses are IPv6), and the VXLAN MTU, in bytes after the Ethernet
        header. The second also fits if the WireGuard device is wider because of another peer.
    """
    left = min(outer_mtu, _OUTER_MTU_MAX) - (_IPV6_BYTES if is_ipv6 else _IPV4_BYTES) - _UDP_BYTES - _DATA_BYTES
    return max(left, _IPV6_MTU_MIN), left // _PADDED_BYTES * _PADDED_BYTES - _INNER_BYTES


class RouteMonitor:
    """The routes to a changing set of endpoints; ``poll`` reports which of them changed.

    Args:
        fwmark: as ``route_mtu``.

    Raises:
        LocalError: the kernel opens no netlink socket.
    """

    def __init__(self, fwmark: int = 0) -> None:
        self._netlink = NetlinkSocket()
        self._fwmark = fwmark
        self._known: dict[Endpoint, Route | None] = {}

    def close(self) -> None:
        """Close its socket."""
        self._netlink.close()

    def poll(self, endpoints: Iterable[Endpoint]) -> dict[Endpoint, tuple[Route | None, Route | None]]:
        """Return the routes that changed since the last call, as before and after.

        Endpoints that were not in the last call are only stored. A route is None while there is none.
        """
        found = {each: route_to(self._netlink, each, self._fwmark) for each in dict.fromkeys(endpoints)}
        known, self._known = self._known, found
        return {each: (known[each], now) for each, now in found.items() if each in known and known[each] != now}

    def watch(self, endpoint: Endpoint) -> None:
        """Store the route of one more endpoint, so that the next ``poll`` reports a change of it."""
        if endpoint not in self._known:
            self._known[endpoint] = route_to(self._netlink, endpoint, self._fwmark)

    def route(self, endpoint: Endpoint) -> Route | None:
        """Return the route of an endpoint at the last ``poll``."""
        return self._known.get(endpoint)


def _route(netlink: NetlinkSocket, values: dict[int, bytes]) -> Route | None:
    ifindex = int.from_bytes(values.get(_RTA_OIF, b""), sys.byteorder)
    cached = nested(values.get(_RTA_METRICS, b"")).get(_RTAX_MTU, b"")
    mtu = int.from_bytes(cached, sys.byteorder)
    if not mtu:
        mtu = int.from_bytes(netlink.link(ifindex).get(LinkAttribute.MTU, b""), sys.byteorder)
    if not mtu:  # the device went away between both requests
        return None
    return Route(ifindex, values.get(_RTA_PREFSRC, b""), values.get(_RTA_GATEWAY, b""), mtu)
