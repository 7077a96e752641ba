"""Packet filter that keeps frames from outside out of the VXLAN devices of tunnels.

I/O; pyroute2, imported only here because it is large. The kernel binds the socket of a VXLAN device to no address and
to no device. So any host that reaches an IPv6 address of this one could send frames into a tunnel's device, past
WireGuard. This filter drops packets to the port of VXLAN unless they come from a WireGuard device of a switch. It
belongs to a netlink socket (``NFT_TABLE_F_OWNER``, Linux 5.12): the kernel removes it with the socket, however the
process ends. It needs CAP_NET_ADMIN only when it is made.

Source: ``include/uapi/linux/netfilter/nf_tables.h``. The same in the words of nft(8)::

    table ip6 NAME { chain outside { type filter hook input priority raw; udp dport PORT iifname != "gw*" drop } }
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from typing import Any, Final

from gdp.errors import LocalError

_NFPROTO_IPV6: Final = 10
_OWNER: Final = 0x2  # NFT_TABLE_F_OWNER
_FIRST: Final = -300  # priority of "raw"
_ACCEPT, _DROP = 1, 0
_REGISTER: Final = 1
_L4PROTO, _IIFNAME = 16, 6
_EQUAL, _OTHER = 0, 1
_TRANSPORT: Final = 2
_CHAIN: Final = "outside"


class OutsideFilter:
    """The filter, until ``close``.

    Args:
        name: of its table, unique on this host.
        port: of VXLAN, UDP over IPv6.
        inside: beginnings of the names of the devices from which packets may come.

    Raises:
        LocalError: the kernel has no nf_tables, or refuses.
    """

    def __init__(self, name: str, port: int, inside: Sequence[str]) -> None:
        from pyroute2.netlink.exceptions import NetlinkError
        from pyroute2.nftables.expressions import verdict
        from pyroute2.nftables.main import NFTables

        dport = {"dreg": _REGISTER, "base": _TRANSPORT, "offset": 2, "len": 2}
        steps = [_matches("meta", _meta(_L4PROTO), _EQUAL, bytes([socket.IPPROTO_UDP]))]
        steps.append(_matches("payload", dport, _EQUAL, port.to_bytes(2, "big")))
        steps += [_matches("meta", _meta(_IIFNAME), _OTHER, each.encode()) for each in inside]
        try:
            self._tables: Any = NFTables(nfgen_family=_NFPROTO_IPV6)
        except OSError as error:
            raise LocalError(f"packet filter: {error.strerror}") from error
        try:
            self._tables.table("add", name=name, NFTA_TABLE_FLAGS=_OWNER)
            hook = {"hook": "input", "priority": _FIRST, "policy": _ACCEPT}
            self._tables.chain("add", table=name, name=_CHAIN, type="filter", **hook)
            self._tables.rule("add", table=name, chain=_CHAIN, expressions=(*steps, verdict(_DROP)))
        except (NetlinkError, OSError) as error:
            self._tables.close()
            number = error.code if isinstance(error, NetlinkError) else error.errno
            raise LocalError(f"packet filter: {os.strerror(number) if number else error}") from error

    def close(self) -> None:
        """Remove the filter."""
        self._tables.close()


def _meta(key: int) -> dict[str, int]:
    return {"key": key, "dreg": _REGISTER}


def _matches(kind: str, load: dict[str, int], comparison: int, value: bytes) -> list[object]:
    """Return the expressions that go on if what ``load`` loads begins with a value, or does not."""
    from pyroute2.nftables.expressions import genex

    data = {"attrs": [("NFTA_DATA_VALUE", value)]}
    return [genex(kind, load), genex("cmp", {"sreg": _REGISTER, "op": comparison, "data": data})]
