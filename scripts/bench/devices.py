"""Network devices of a namespace: addresses, bridges, counters. Each function works in the namespace of its caller.

I/O. Netlink.
"""

from __future__ import annotations

from collections.abc import Sequence

from pyroute2 import IPRoute


def add_address(device: str, address: str) -> None:
    """Give a device an IPv4 address of a network of 24 bits."""
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.addr("add", index=index, address=address, prefixlen=24)


def add_bridge(name: str, devices: Sequence[str] = ()) -> None:
    """Join devices by a new bridge without spanning tree."""
    with IPRoute() as here:
        here.link("add", ifname=name, kind="bridge", br_stp_state=0, br_forward_delay=0)
        (bridge,) = here.link_lookup(ifname=name)
        for device in devices:
            here.link("set", index=here.link_lookup(ifname=device)[0], master=bridge)
        here.link("set", index=bridge, state="up")


def add_neighbour(device: str, address: str, mac: bytes) -> None:
    """Name the MAC address of an IPv4 neighbour for good, so that nothing asks for it."""
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.neigh("add", dst=address, lladdr=mac.hex(":"), ifindex=index, state="permanent")


def set_link(device: str, **change: str | int) -> None:
    """Change a device: ``state``, ``mtu`` in bytes, or ``net_ns_fd``, the namespace of a descriptor to move it to."""
    with IPRoute() as here:
        here.link("set", index=here.link_lookup(ifname=device)[0], **change)


def received(devices: Sequence[str]) -> dict[str, int]:
    """Return how many frames have come in, by device."""
    with IPRoute() as here:
        links = {link.get_attr("IFLA_IFNAME"): link.get_attr("IFLA_STATS64") for link in here.get_links()}
    return {device: links[device]["rx_packets"] for device in devices}


def mac_addresses(devices: Sequence[str]) -> dict[str, bytes]:
    """Return the MAC addresses, by device."""
    with IPRoute() as here:
        links = {link.get("ifname"): link.get("address") for link in here.get_links()}
    return {device: bytes.fromhex(links[device].replace(":", "")) for device in devices}
