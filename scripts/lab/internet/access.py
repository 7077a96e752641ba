"""Kinds of internet access, which pairs of them allow a direct UDP path, and the nftables rules of each.

Sans-I/O. Source: RFC 4787 for mapping and filtering; RFC 5128, section 3, for hole punching; nft(8). Linux keeps the
source port of a masqueraded socket where it can, for all destinations: an endpoint-independent mapping with address and
port-dependent filtering. With ``fully-random`` each destination gets a port of its own. A map of public ports that
postrouting fills gives endpoint-independent filtering.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Final


class Access(str, Enum):
    """What lies between a host and the internet."""

    PUBLIC = "public"  # routed, no filter, both IP versions
    FULL_CONE = "full cone"
    PORT_RESTRICTED = "port restricted"
    SYMMETRIC = "symmetric"
    DOUBLE_NAT = "double NAT"  # port restricted at home, and again at the carrier
    UDP_BLOCKED = "UDP blocked"  # TCP to port 443 passes, nothing else
    IPV6_ONLY = "IPv6 only"  # routed, behind a firewall that lets replies in


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """Properties of an access as RFC 4787 names them.

    Args:
        versions: IP versions that hosts have.
        passes_udp: whether UDP leaves the site.
        is_mapping_stable: whether one socket has one public endpoint for all destinations (endpoint-independent
            mapping).
        is_filtering: whether datagrams come in only from endpoints that the socket has sent to (address and
            port-dependent filtering); otherwise from any.
    """

    versions: frozenset[int] = frozenset({4})
    passes_udp: bool = True
    is_mapping_stable: bool = True
    is_filtering: bool = True


TRAITS: Final = {
    Access.PUBLIC: Traits(versions=frozenset({4, 6}), is_filtering=False),
    Access.FULL_CONE: Traits(is_filtering=False),
    Access.PORT_RESTRICTED: Traits(),
    Access.SYMMETRIC: Traits(is_mapping_stable=False),
    Access.DOUBLE_NAT: Traits(),
    Access.UDP_BLOCKED: Traits(passes_udp=False),
    Access.IPV6_ONLY: Traits(versions=frozenset({6})),
}


def allows_direct(one: Access, other: Access) -> bool:
    """Return whether two sockets that send to each other's observed endpoint at once can reach each other by UDP.

    An observed endpoint is what a third host sees. A socket with an unstable mapping sends from another one to its
    peer, so the peer must accept datagrams from any endpoint. It then answers to the source that it sees.
    """
    a, b = TRAITS[one], TRAITS[other]
    if not (a.passes_udp and b.passes_udp and a.versions & b.versions):
        return False
    return (a.is_mapping_stable or not b.is_filtering) and (b.is_mapping_stable or not a.is_filtering)


WAN: Final = "wan"  # device of a router towards the internet
LAN: Final = "lan"  # towards its hosts
FLUSH_MAPPINGS: Final = "flush map inet site mapped"
_TLS_PORT: Final = 443

# A datagram that finds no mapping is dropped in ``input``. Without that, its connection entry would take the port
# that the local socket is about to get, and a hole could be opened from one side only.
_TABLE: Final = """
table inet site
delete table inet site
table inet site {{
  map mapped {{ type inet_service : ipv4_addr . inet_service; flags dynamic,timeout; timeout 5m; size 65535; }}
  chain prerouting {{ type nat hook prerouting priority dstnat;
    {prerouting}
  }}
  chain record {{ type filter hook postrouting priority srcnat - 10;
    {record}
  }}
  chain postrouting {{ type nat hook postrouting priority srcnat;
    {postrouting}
  }}
  chain input {{ type filter hook input priority filter; policy drop;
    ct state established,related accept
    iifname {{ "lo", "lan" }} meta l4proto {{ icmp, ipv6-icmp }} accept
    iifname "wan" meta l4proto ipv6-icmp accept
  }}
  chain forward {{ type filter hook forward priority filter; policy drop;
    ct state established,related accept
    ct status dnat accept
    {forward}
  }}
}}
"""


def router_rules(access: Access, wan_address: str) -> str:
    """Return the rules of a router, which replace those it has; empty for public access.

    ``access``: kind of the site. ``wan_address``: IPv4 address of the router's device ``wan``; empty: it has none.
    """
    if access is Access.PUBLIC:
        return ""
    prerouting, record, postrouting = [], [], []
    forward = f'iifname "{LAN}" oifname "{WAN}" accept'
    if wan_address:
        postrouting.append(f'oifname "{WAN}" meta nfproto ipv4 masquerade{_randomness(access)}')
    if wan_address and access is not Access.SYMMETRIC:
        record.append(f'oifname "{WAN}" meta nfproto ipv4 update @mapped {{ udp sport : ip saddr . udp sport }}')
    if access is Access.FULL_CONE:
        prerouting.append(f'iifname "{WAN}" meta nfproto ipv4 dnat ip to udp dport map @mapped')
    if access is Access.UDP_BLOCKED:
        forward = f'iifname "{LAN}" oifname "{WAN}" tcp dport {_TLS_PORT} accept'
    return _TABLE.format(
        prerouting="\n    ".join(prerouting),
        record="\n    ".join(record),
        postrouting="\n    ".join(postrouting),
        forward=forward,
    )


def _randomness(access: Access) -> str:
    return " random,fully-random" if access is Access.SYMMETRIC else ""


def core_rules(cut: Iterable[str]) -> str:
    """Return the rules of the core, which replace those it has: silent drops at the devices towards cut sites."""
    drops = [f'{way} "{device}" drop' for device in cut for way in ("iifname", "oifname")]
    lines = "\n    ".join(drops)
    return f"""
table inet core
delete table inet core
table inet core {{
  chain forward {{ type filter hook forward priority filter; policy accept;
    {lines}
  }}
}}
"""
