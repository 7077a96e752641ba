"""Network devices, addresses and routes of a node, made and removed through netlink.

I/O. Source: rtnetlink(7); ``include/uapi/linux/if_link.h``, ``if_addr.h``, ``rtnetlink.h``. Every device carries the
alias of its switch. The alias tells the devices of a dead run of the same switch from those of other programs::

    ifaddrmsg  family (1)  prefix length (1)  flags (1)  scope (1)  index (4)
    rtmsg      family (1)  destination length (1)  source length (1)  tos (1)  table (1)  protocol (1)  scope (1)
               type (1)  flags (4)
"""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
import struct
from contextlib import closing, suppress
from pathlib import Path
from typing import Final, NamedTuple

from gdp.errors import LocalError
from gdp.ports.netlink import NUMBER, ROUTE, Change, LinkAttribute, NetlinkSocket, RefusedError, Rtm, attribute, nested
from gdp.ports.sockets import AS_ROOT

_INFO: Final = struct.Struct("=BxHiII")
_ADDRESS: Final = struct.Struct("=BBBBI")
_IFF_UP: Final = 1
_INFO_KIND, _INFO_DATA = 1, 2  # IFLA_INFO_KIND, IFLA_INFO_DATA
_PEER: Final = 1  # VETH_INFO_PEER
_AF_SPEC, _ADDR_GEN_MODE, _MODE_NONE = 26, 8, 1  # IFLA_AF_SPEC, IFLA_INET6_ADDR_GEN_MODE, IN6_ADDR_GEN_MODE_NONE
_IFA_ADDRESS, _IFA_LOCAL = 1, 2
_IFA_F_NODAD: Final = 0x02  # the address follows from a name: a duplicate is an error that DAD would not find
_RTA_DST, _RTA_OIF = 1, 4
_TABLE_MAIN: Final = 254
_PROTOCOL_STATIC: Final = 4
_UNICAST: Final = 1
_NESTED: Final = 0x8000  # NLA_F_NESTED


class Device(NamedTuple):
    """A device of this namespace.

    Attributes:
        kind: driver, such as ``tun`` or ``wireguard``; empty for a physical device.
        data: attributes of the driver, by their number.
    """

    ifindex: int
    ifname: str
    mtu: int
    alias: str
    kind: str
    data: dict[int, bytes]


def find_device(ifname: str) -> Device | None:
    """Return the device of this name, or None."""
    with closing(NetlinkSocket()) as netlink:
        info = netlink.link_named(ifname)
    if info is None:
        return None
    driver = nested(info.attributes.get(LinkAttribute.LINKINFO, b""))
    return Device(
        ifindex=info.ifindex,
        ifname=ifname,
        mtu=info.number(LinkAttribute.MTU),
        alias=info.text(LinkAttribute.IFALIAS),
        kind=driver.get(_INFO_KIND, b"").rstrip(b"\0").decode(errors="replace"),
        data=nested(driver.get(_INFO_DATA, b"")),
    )


def add_device(ifname: str, kind: str, data: bytes = b"", attributes: bytes = b"") -> None:
    """Make a device.

    Args:
        data: attributes of its driver.
        attributes: further attributes of the device.

    Raises:
        RefusedError: the kernel refuses.
    """
    driver = attribute(_INFO_KIND, kind.encode() + b"\0") + (attribute(_INFO_DATA | _NESTED, data) if data else b"")
    body = _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + attribute(LinkAttribute.IFNAME, ifname.encode() + b"\0")
    body += attributes + attribute(LinkAttribute.LINKINFO | _NESTED, driver)
    _change(Rtm.NEWLINK, body, Change.CREATE | Change.EXCLUSIVE)


def add_pair(ifname: str, other: str, mtu: int) -> None:
    """Make a veth pair. Raises ``RefusedError``."""
    size = attribute(LinkAttribute.MTU, NUMBER.pack(mtu))
    far = bytes(_INFO.size) + attribute(LinkAttribute.IFNAME, other.encode() + b"\0") + size
    add_device(ifname, "veth", attribute(_PEER, far), size)


def set_alias(ifindex: int, alias: str) -> None:
    """Set the alias of a device. Raises ``RefusedError``."""
    _set(ifindex, attribute(LinkAttribute.IFALIAS, alias.encode()))


def set_mtu(ifindex: int, mtu: int) -> None:
    """Set the MTU of a device, in bytes. Raises ``RefusedError``."""
    _set(ifindex, attribute(LinkAttribute.MTU, NUMBER.pack(mtu)))


def set_queue_length(ifindex: int, packets: int) -> None:
    """Set how many packets a device queues before it drops. Raises ``RefusedError``."""
    _set(ifindex, attribute(LinkAttribute.TXQLEN, NUMBER.pack(packets)))


def make_up(ifindex: int) -> None:
    """Switch a device on. Raises ``RefusedError``."""
    _change(Rtm.SETLINK, _INFO.pack(socket.AF_UNSPEC, 0, ifindex, _IFF_UP, _IFF_UP))


def without_addresses(ifindex: int) -> None:
    """Keep the kernel from giving a device an IPv6 address of its own; it then sends nothing by itself."""
    inet6 = attribute(socket.AF_INET6 | _NESTED, attribute(_ADDR_GEN_MODE, bytes([_MODE_NONE])))
    _set(ifindex, attribute(_AF_SPEC | _NESTED, inet6))


def bring_up(ifname: str, alias: str, *further: tuple[LinkAttribute, int]) -> int:
    """Give a new device its alias and further numbers, switch it on without IPv6, and return its ifindex.

    Raises:
        RefusedError: the kernel refuses.
        LocalError: another program removed the device.
    """
    with suppress(OSError):  # absent or read-only in some containers; the cost is only a few dropped frames
        Path(f"/proc/sys/net/ipv6/conf/{ifname}/disable_ipv6").write_text("1", encoding="ascii")
    device = find_device(ifname)
    if device is None:
        raise LocalError(f"another program removed the device {ifname}")
    body = _INFO.pack(socket.AF_UNSPEC, 0, device.ifindex, _IFF_UP, _IFF_UP)
    body += attribute(LinkAttribute.IFALIAS, alias.encode())
    _change(Rtm.SETLINK, body + b"".join(attribute(kind, NUMBER.pack(value)) for kind, value in further))
    return device.ifindex


def remove_device(ifindex: int) -> None:
    """Remove a device; does nothing if it is gone. Raises ``RefusedError``."""
    try:
        _change(Rtm.DELLINK, _INFO.pack(socket.AF_UNSPEC, 0, ifindex, 0, 0))
    except RefusedError as error:
        if error.number != errno.ENODEV:
            raise


def remove_own_device(ifname: str, alias: str) -> bool:
    """Remove the device of this name if it carries this alias; return whether there was one.

    Raises:
        LocalError: a device of that name belongs to another program; it is left alone.
    """
    device = find_device(ifname)
    if device is None:
        return False
    if device.alias != alias:
        raise LocalError(f"the device {ifname} exists and is not ours; remove it with: ip link del {ifname}")
    remove_device(device.ifindex)
    return True


def add_address(ifindex: int, address: str) -> None:
    """Add an IPv6 address without a prefix to a device; does nothing if it has it. Raises ``RefusedError``."""
    packed = ipaddress.IPv6Address(address).packed
    body = _ADDRESS.pack(socket.AF_INET6, 128, _IFA_F_NODAD, 0, ifindex)
    _change_once(Rtm.NEWADDR, body + attribute(_IFA_LOCAL, packed) + attribute(_IFA_ADDRESS, packed))


def add_route(ifindex: int, address: str) -> None:
    """Lead an IPv6 address through a device; routes of it through other devices stay. Raises ``RefusedError``."""
    _change_once(Rtm.NEWROUTE, _route(ifindex, address, _PROTOCOL_STATIC))


def remove_route(ifindex: int, address: str) -> None:
    """Undo ``add_route``; does nothing if there is none. Raises ``RefusedError``."""
    try:
        _change(Rtm.DELROUTE, _route(ifindex, address, _PROTOCOL_STATIC))
    except RefusedError as error:
        if error.number not in (errno.ESRCH, errno.ENODEV):
            raise


def refusal_text(error: RefusedError) -> str:
    """Return what the kernel refused, and what to do if this user lacks a right."""
    if error.number in (errno.EPERM, errno.EACCES):
        return f"not permitted; {AS_ROOT}"
    return os.strerror(error.number)


def _route(ifindex: int, address: str, protocol: int) -> bytes:
    body = ROUTE.pack(socket.AF_INET6, 128, 0, 0, _TABLE_MAIN, protocol, 0, _UNICAST, 0)
    destination = attribute(_RTA_DST, ipaddress.IPv6Address(address).packed)
    return body + destination + attribute(_RTA_OIF, NUMBER.pack(ifindex))


def _set(ifindex: int, attributes: bytes) -> None:
    _change(Rtm.SETLINK, _INFO.pack(socket.AF_UNSPEC, 0, ifindex, 0, 0) + attributes)


def _change_once(kind: Rtm, body: bytes) -> None:
    try:
        _change(kind, body, Change.CREATE)
    except RefusedError as error:
        if error.number != errno.EEXIST:
            raise


def _change(kind: Rtm, body: bytes, flags: int = 0) -> None:
    with closing(NetlinkSocket()) as netlink:
        netlink.change(kind, body, flags)
