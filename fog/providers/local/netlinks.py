"""Network devices between machines, gateways and the robot.

I/O; needs CAP_NET_ADMIN in the affected namespaces. Functions raise ``LocalError`` if the kernel refuses.

A gateway's namespace with two machines::

    up ---- towards the robot          to-LABEL ---- towards a gateway behind this one

    machines ==== machines-b -+
                              |-- segment (a bridge: what a switch port with several neighbours looks like)
                  m-1f2e3d ---+        |
                     ||             m-4c5b6a
                  eth0 of a machine    ||
                                    eth0 of another

If a machine is the gateway, the namespace has no switch and no ``machines``. A second bridge keeps the link towards
the robot up while the role moves::

    up ---- uplink (a bridge) ---- g-1f2e3d ==== up of the machine that is the gateway

If both ends of a pair have the same index, Linux may report a lost carrier one second late, so one end has a high index
(see ``scripts/lab/namespaces.py``). Only the loopback device has an address.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from gdp.errors import LocalError
from gdp.host import netns_files
from gdp.host.run_registry import in_first_user_namespace

if TYPE_CHECKING:
    from pyroute2 import IPRoute  # imported here: it takes 0.2 s to load, and most commands do not need it

MACHINE_DEVICE: Final = "eth0"
UP: Final = "up"
MACHINES: Final = "machines"
SEGMENT: Final = "segment"
UPLINK_BRIDGE: Final = "uplink"
_MTU: Final = 1_500
_LOOPBACK: Final = 1
_HIGH_INDEX: Final = 1 << 20

T = TypeVar("T")


def space_path(run: str, directory: Path, label: str) -> Path:
    """Return the path of a namespace of a run; ``directory``: folder of the run."""
    folder = netns_files.IP_NETNS_DIRECTORY if in_first_user_namespace() else directory / "netns"
    return folder / f"gdp-{run}-{label}"


def make_space(path: Path, address: str) -> None:
    """Create a namespace whose loopback has this additional address; empty: none."""
    netns_files.create(path)
    netns_files.inside(path, netns_files.disable_ipv6)
    _ask(path, partial(_raise_loopback, address))


def join(near: Path | None, near_device: str, far: Path, far_device: str) -> None:
    """Connect two namespaces by a veth pair; ``near`` None: the namespace of the caller."""
    with _opened(far) as far_fd:
        _ask(near, partial(_add_pair, near_device, {"ifname": far_device, "net_ns_fd": far_fd}))
    _ask(far, partial(_set_up, far_device))


def join_within(space: Path, device: str, other: str) -> None:
    """Create a veth pair in one namespace."""

    def work(links: IPRoute) -> None:
        _add_pair(device, {"ifname": other}, links)
        _set_up(other, links)

    _ask(space, work)


def make_segment(gateway: Path) -> None:
    """Create a dedicated gateway's bridge and the gateway's port on it."""
    make_bridge(gateway, SEGMENT)
    join_within(gateway, MACHINES, f"{MACHINES}-b")
    plug(gateway, f"{MACHINES}-b")


def make_bridge(space: Path, name: str) -> None:
    """Create a bridge."""

    def make(links: IPRoute) -> None:
        links.link("add", ifname=name, kind="bridge", br_mcast_snooping=0)
        _set_up(name, links)

    _ask(space, make)


def plug(gateway: Path, device: str, *, into: bool = True, bridge: str = SEGMENT) -> None:
    """Connect a device with a bridge in a gateway's namespace, or disconnect it."""
    _ask(gateway, partial(_enslave, device, bridge) if into else partial(_release, device))


def delete(space: Path | None, device: str) -> None:
    """Delete a device and the other end of its pair; no effect if the device or its namespace is gone."""

    from pyroute2.netlink.exceptions import NetlinkError

    def work(links: IPRoute) -> None:
        with suppress(NetlinkError):  # removed after the check
            for index in links.link_lookup(ifname=device):
                links.link("del", index=index)

    if space is None or netns_files.reach(space) is not None:
        _ask(space, work)


def exists(space: Path | None, device: str) -> bool:
    """Return whether a device of this name exists."""
    return _ask(space, lambda links: bool(links.link_lookup(ifname=device)))


def _ask(space: Path | None, work: Callable[[IPRoute], T]) -> T:
    from pyroute2 import IPRoute
    from pyroute2.netlink.exceptions import NetlinkError

    def ask() -> T:
        with IPRoute() as links:
            return work(links)

    try:
        return ask() if space is None else netns_files.inside(space, ask)
    except (NetlinkError, OSError) as error:
        raise LocalError(f"devices of {space.name if space else 'this namespace'}: {error}") from error


@contextmanager
def _opened(space: Path) -> Iterator[int]:
    try:
        descriptor = os.open(netns_files.reach(space) or space, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise LocalError(f"namespace {space.name}: {error.strerror}") from error
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _raise_loopback(address: str, links: IPRoute) -> None:
    links.link("set", index=_LOOPBACK, state="up")
    if address:
        links.addr("add", index=_LOOPBACK, address=address, prefixlen=32)


def _add_pair(device: str, peer: dict[str, object], links: IPRoute) -> None:
    """Create a pair and set its near end up."""
    number = {} if "net_ns_fd" not in peer else {"index": _HIGH_INDEX}
    links.link("add", kind="veth", ifname=device, mtu=_MTU, peer={**peer, **number, "mtu": _MTU})
    _set_up(device, links)


def _set_up(device: str, links: IPRoute) -> None:
    links.link("set", index=_index(device, links), state="up")


def _enslave(device: str, bridge: str, links: IPRoute) -> None:
    links.link("set", index=_index(device, links), master=_index(bridge, links))


def _release(device: str, links: IPRoute) -> None:
    links.link("set", index=_index(device, links), master=0)


def _index(device: str, links: IPRoute) -> int:
    found = links.link_lookup(ifname=device)
    if not found:
        raise LocalError(f"no device {device}")
    return int(found[0])
