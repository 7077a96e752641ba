"""Kinds of internet access, and which pairs of them allow a direct UDP path.

Sans-I/O. Source: RFC 4787 for mapping and filtering; RFC 5128, section 3, for hole punching.
"""

from __future__ import annotations

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
