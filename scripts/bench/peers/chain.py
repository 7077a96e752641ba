"""Five machines in a row, A - s1 - s2 - s3 - B, that all contenders use in turn: by names, by routers, by IPv4.

I/O; namespaces through ``gdp.simulation``. Link ``n`` (from 0) has the network 10.99.n.0/24, its left end .1, its
right end .2; the three in the middle forward IPv4::

    a  .1 --10.99.0-- .2  s1  .1 --10.99.1-- .2  s2  .1 --10.99.2-- .2  s3  .1 --10.99.3-- .2  b
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final, TypeVar

from machine import offload_text, offloads, set_offloads
from pyroute2 import IPRoute

from gdp.host import netns_files
from gdp.host.run_registry import Run
from gdp.simulation.namespaces import Namespaces
from gdp.simulation.topology import Attachment, DomainPlan, Link, Topology
from peers.process import Started

__all__ = ["LEFT", "MIDDLE", "NODES", "RIGHT", "Chain", "address", "five", "routes"]

LEFT: Final = "a"
MIDDLE: Final = ("s1", "s2", "s3")
RIGHT: Final = "b"
NODES: Final = (LEFT, *MIDDLE, RIGHT)
_LINKS: Final = len(NODES) - 1
_FORWARD: Final = Path("/proc/sys/net/ipv4/ip_forward")

T = TypeVar("T")


def five(mtu: int) -> Topology:
    """Return the five as a topology; only the three in the middle switch, and A and B hang at s1 and s3 as proxies.

    Raises:
        LocalError: the MTU is out of bounds.
    """
    return Topology(
        links=tuple(Link(a, b, mtu=mtu) for a, b in pairwise(NODES)),
        domains=(DomainPlan("chain", NODES),),
        attachments=(
            Attachment("s2", "rib", "rib"),
            Attachment(LEFT, "proxy", "end"),
            Attachment(RIGHT, "proxy", "end"),
        ),
    )


def address(node: str, towards: str) -> str:
    """Return the IPv4 address of a machine's device towards a neighbour."""
    own, other = NODES.index(node), NODES.index(towards)
    return f"10.99.{own}.1" if other > own else f"10.99.{other}.2"


def routes(node: str) -> dict[str, str]:
    """Return a machine's routes to the networks that it is not part of: network to gateway."""
    own, found = NODES.index(node), dict[str, str]()
    for link in range(_LINKS):
        if link not in (own - 1, own):
            neighbour = NODES[own + 1 if link > own else own - 1]
            found[f"10.99.{link}.0/24"] = address(neighbour, node)
    return found


class Chain:
    """The five namespaces, addressed and routed; ``run.end()`` removes them.

    Raises:
        LocalError: the kernel refuses.
    """

    def __init__(self, mtu: int, run: Run) -> None:
        self.mtu = mtu
        self.run = run
        self.topology = five(mtu)
        self.directory = run.directory
        self._spaces = Namespaces(self.topology, run)
        for node in NODES:
            self._inside(node, partial(_number, node))

    def set_offloads(self, *, on: bool) -> str:
        """Switch the offloads of every device of the row, and return how they are then, as the devices say."""
        found = [self._inside(node, partial(_switch_offloads, _neighbours(node), on=on)) for node in NODES]
        return offload_text([one for each in found for one in each])

    def start(self, node: str, what: str, arguments: Sequence[str]) -> Started:
        """Start Python with these arguments on a machine; it dies with us.

        Args:
            what: for its log and for error messages.
        """
        return Started(self.run, f"{what} at {node}", lambda argv: self._spaces.command(node, argv), arguments)

    def _inside(self, node: str, work: Callable[[], T]) -> T:
        return netns_files.inside(self._spaces.path(node), work)


def _neighbours(node: str) -> tuple[str, ...]:
    own = NODES.index(node)
    return NODES[max(own - 1, 0) : own] + NODES[own + 1 : own + 2]


def _number(node: str) -> None:
    with IPRoute() as here:
        for other in _neighbours(node):
            (device,) = here.link_lookup(ifname=other)
            here.addr("add", index=device, address=address(node, other), prefixlen=24)
        for network, gateway in routes(node).items():
            here.route("add", dst=network, gateway=gateway)
    if node in MIDDLE:
        _FORWARD.write_text("1", encoding="ascii")


def _switch_offloads(devices: Sequence[str], *, on: bool) -> list[dict[str, bool]]:
    for device in devices:
        set_offloads(device, on=on)
    return [offloads(device) for device in devices]
