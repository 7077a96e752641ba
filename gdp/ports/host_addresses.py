"""Addresses of this host's devices at which a peer may reach it.

I/O; rtnetlink(7). It is called at each change of an address, when a node's loop must not wait.
"""

from __future__ import annotations

import ipaddress
import socket
import struct
from collections.abc import Collection
from contextlib import closing
from typing import Final

from gdp.ports.netlink import DeviceInfo, LinkAttribute, NetlinkSocket, nested

__all__ = ["host_addresses"]

_RTM_NEWADDR, _RTM_GETADDR = 20, 22
_ADDRESS: Final = struct.Struct("=BBBBI")  # family, prefix length, flags, scope, device
_FLAGS: Final = struct.Struct("=I")
_IFA_ADDRESS, _IFA_LOCAL, _IFA_FLAGS = 1, 2, 8
_UNIVERSE: Final = 0  # RT_SCOPE_UNIVERSE: neither of a link nor of the host alone
_NOT_READY: Final = 0x08 | 0x20 | 0x40  # IFA_F_DADFAILED, IFA_F_DEPRECATED, IFA_F_TENTATIVE


def host_addresses(excluded: Collection[str] = (), only: str | None = None) -> list[str]:
    """Return the numeric addresses of global scope, IPv6 last.

    Args:
        excluded: names of devices that do not count.
        only: name of the one device that counts; None: all do.

    Raises:
        LocalError: the kernel does not reply.
    """
    found = []
    with closing(NetlinkSocket()) as netlink:
        names = {}
        for message in netlink.links():
            device = DeviceInfo.from_body(message.body)
            names[device.ifindex] = device.attributes.get(LinkAttribute.IFNAME, b"").rstrip(b"\0").decode()
        for message in netlink.dump(_RTM_GETADDR, _ADDRESS.pack(socket.AF_UNSPEC, 0, 0, 0, 0)):
            if message.kind != _RTM_NEWADDR:
                continue
            _, _, flags, scope, ifindex = _ADDRESS.unpack_from(message.body)
            values = nested(message.body[_ADDRESS.size :])
            if _IFA_FLAGS in values:  # all of them; the header has the lowest eight
                (flags,) = _FLAGS.unpack(values[_IFA_FLAGS])
            name = names.get(ifindex)
            is_counted = name not in excluded and only in (None, name)
            packed = values.get(_IFA_LOCAL) or values.get(_IFA_ADDRESS)
            if is_counted and packed and scope == _UNIVERSE and not flags & _NOT_READY:
                found.append(ipaddress.ip_address(packed))
    return [str(each) for each in sorted(found, key=lambda each: (each.version, each.packed))]
