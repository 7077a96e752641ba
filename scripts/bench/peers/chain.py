"""Five machines in a row, A - s1 - s2 - s3 - B, shared by all baselines: by names, by routers, by IPv4.

I/O; namespaces through ``lab.namespaces``. Link ``n`` (from 0) has the network 10.99.n.0/24, its left end .1, its
right end .2; the three in the middle forward IPv4::

    a  .1 --10.99.0-- .2  s1  .1 --10.99.1-- .2  s2  .1 --10.99.2-- .2  s3  .1 --10.99.3-- .2  b
"""

from __future__ import annotations

from functools import partial
from typing import Final

from gdp.host.run_registry import Run
from lab.machines import Lab
from lab.namespaces import clear_offloads
from lab.topology import MIDDLE, ROW, row

NODES: Final = ROW
_LINKS: Final = len(NODES) - 1


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


class Chain(Lab):
    """The five machines, addressed and routed, without offloads. Raises ``LocalError``: the kernel refuses."""

    def __init__(self, mtu: int, run: Run) -> None:
        super().__init__(run, row(mtu))
        for node in NODES:
            neighbours = self.topology.neighbours(node)
            addresses = [f"addr add {address(node, other)}/24 dev {other}" for other in neighbours]
            ways = [f"route add {network} via {gateway}" for network, gateway in routes(node).items()]
            self.namespaces[node].configure([*addresses, *ways])
            for other in neighbours:
                self.inside(node, partial(clear_offloads, other))
        for node in MIDDLE:
            self.namespaces[node].set("ipv4/ip_forward", 1)
