"""VXLAN devices: one point-to-point Ethernet link inside a tunnel, used as an ordinary port of a switch.

I/O. Source: RFC 7348; ``IFLA_VXLAN_`` in ``include/uapi/linux/if_link.h``. A device learns no addresses: its only
destination is the remote inner address. Its socket receives from all devices; ``OutsideFilter`` drops what does not
come from a tunnel. WireGuard authenticates each packet, so the UDP checksum is left out (RFC 6935).
"""

from __future__ import annotations

import ipaddress
import struct
from typing import Final

from gdp.errors import LocalError
from gdp.ports.netlink import NUMBER, LinkAttribute, RefusedError, attribute
from gdp.ports.tunnel.devices import (
    add_device,
    find_device,
    make_up,
    refusal_text,
    remove_device,
    remove_own_device,
    set_alias,
    set_mtu,
    without_addresses,
)

VXLAN_PORT: Final = 24_789  # not 4789, where other programs on this host may receive from outside
_ID, _LINK, _LEARNING, _PORT = 1, 3, 7, 15
_REMOTE6, _LOCAL6 = 16, 17
_ZERO_CSUM6_TX, _ZERO_CSUM6_RX = 19, 20


def make_vxlan(*, ifname: str, vni: int, local: str, remote: str, underlay: str, mtu: int, alias: str) -> None:
    """Make a VXLAN device and switch it on; one that a dead run of this switch left is replaced.

    Args:
        vni: VXLAN network identifier, 24 bits, the same at both ends.
        local: inner IPv6 address of this end.
        remote: inner IPv6 address of the other end.
        underlay: device of the tunnel.
        mtu: bytes after the Ethernet header; the kernel lowers it to what the tunnel's device carries.
        alias: identifies the devices of this switch.

    Raises:
        LocalError: the device exists and is not ours, the tunnel's device is missing, or the kernel refuses.
    """
    tunnel = find_device(underlay)
    if tunnel is None:
        raise LocalError(f"tunnel {ifname}: there is no device {underlay}")
    data = attribute(_ID, NUMBER.pack(vni)) + attribute(_LINK, NUMBER.pack(tunnel.ifindex))
    data += attribute(_LOCAL6, ipaddress.IPv6Address(local).packed)
    data += attribute(_REMOTE6, ipaddress.IPv6Address(remote).packed)
    data += attribute(_PORT, struct.pack("!H", VXLAN_PORT)) + attribute(_LEARNING, b"\0")
    data += attribute(_ZERO_CSUM6_TX, b"\1") + attribute(_ZERO_CSUM6_RX, b"\1")
    remove_own_device(ifname, alias)
    try:
        add_device(ifname, "vxlan", data, attribute(LinkAttribute.MTU, NUMBER.pack(mtu)))
        made = find_device(ifname)
        if made is None:
            raise LocalError(f"tunnel {ifname}: another program removed the device")
        try:
            set_alias(made.ifindex, alias)
            without_addresses(made.ifindex)
            make_up(made.ifindex)
        except RefusedError:
            remove_device(made.ifindex)
            raise
    except RefusedError as error:
        raise LocalError(f"tunnel {ifname}: the VXLAN device cannot be made: {refusal_text(error)}") from error


def set_link_mtu(ifname: str, mtu: int) -> None:
    """Set the MTU of a device, in bytes after the Ethernet header.

    Raises:
        LocalError: the device is missing, or the kernel refuses.
    """
    device = find_device(ifname)
    if device is None:
        raise LocalError(f"tunnel {ifname}: no such device")
    if device.mtu != mtu:
        try:
            set_mtu(device.ifindex, mtu)
        except RefusedError as error:
            raise LocalError(f"tunnel {ifname}: MTU {mtu}: {refusal_text(error)}") from error


def remove_link(ifname: str, alias: str) -> None:
    """Remove a device that carries this alias; does nothing if there is no device of that name.

    Raises:
        LocalError: a device of that name belongs to another program, or the kernel refuses.
    """
    try:
        remove_own_device(ifname, alias)
    except RefusedError as error:
        raise LocalError(f"tunnel {ifname}: not removed: {refusal_text(error)}") from error
