"""Baselines of the forwarding bench: the planes of this project, the Linux bridge, the kernel's IPv4 forwarding.

I/O. Each baseline sets up namespaces of the bench and restores them. All use the same chain, one at a time.

The other systems are set up as cheaply as possible. The bridge learns both addresses from a round trip before it is
measured. IPv4 has static neighbours, so no ARP request is sent. The last static neighbour has an address that is not
the endpoint's own: the IP stack there discards a frame at once instead of routing it. The endpoint's packet socket
receives the frame all the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from socket import AF_INET
from typing import Final

from chains import Chain
from frames import SINK, SOURCE, Wire, gdp_frame, ip_frame
from pyroute2 import IPRoute
from testbed import add_bridge

from gdp.frame.kinds import ETHERTYPE
from lab.process import LabProcess

_READY_S: Final = 120.0
_IPV4: Final = 0x0800
_ABSENT: Final = "02:67:64:70:ff:ff"
_BRIDGE: Final = "bridge"
_IP_SETTINGS: Final = Path("/proc/sys/net/ipv4")


class Baseline:
    """A way to forward; this one has no forwarder: the endpoints are joined directly, for the cost of these.

    ``name``: as it stands in tables. ``processes``: user processes in the middle that every frame goes through.
    """

    processes = False

    def __init__(self, name: str) -> None:
        self.name = name

    def wire(self, chain: Chain, size: int) -> Wire:
        """Return frames of ``size`` bytes, Ethernet header included; of GDP, addressed to the next node."""
        nodes = chain.nodes
        return _gdp_wire(chain, size, chain.mac(nodes[1], nodes[0]), chain.mac(nodes[-2], nodes[-1]))

    @contextmanager
    def stand(self, chain: Chain) -> Iterator[list[LabProcess]]:  # noqa: ARG002
        """Set it up in every middle of the chain for a context; yield the processes that forward.

        Raises ``LocalError``: it is not available here; the text gives the reason.
        """
        yield []


class Plane(Baseline):
    """A plane of this project, by its name in ``roles.py``.

    ``name``: the plane. ``processes``: frames go through the process, not only through the kernel.
    """

    def __init__(self, name: str, *, processes: bool) -> None:
        super().__init__(name)
        self.processes = processes

    @contextmanager
    def stand(self, chain: Chain) -> Iterator[list[LabProcess]]:
        """Run a switch in every middle."""
        with ExitStack() as undo:
            workers = []
            for node in chain.middles:
                left, right = chain.devices(node)
                ways = {
                    "left": f"{left} {chain.mac(left, node).hex()}",
                    "right": f"{right} {chain.mac(right, node).hex()}",
                }
                workers.append(undo.enter_context(chain.worker(node, "switch", plane=self.name, ways=ways)))
            for worker in workers:
                worker.read(_READY_S)
            yield workers


class Bridge(Baseline):
    """The Linux bridge: one in each middle namespace, with that node's two devices."""

    def wire(self, chain: Chain, size: int) -> Wire:
        """Return GDP frames addressed to the other endpoint, as a bridge needs them."""
        nodes = chain.nodes
        return _gdp_wire(chain, size, chain.mac(nodes[-1], nodes[-2]), chain.mac(nodes[0], nodes[1]))

    @contextmanager
    def stand(self, chain: Chain) -> Iterator[list[LabProcess]]:
        """Make a bridge in every middle."""
        with ExitStack() as undo:
            for node in chain.middles:
                undo.callback(chain.inside, node, _remove_bridge)
                chain.inside(node, partial(add_bridge, _BRIDGE, chain.devices(node)))
            chain.round_trips(self.wire(chain, 128), 10, poll=False)  # every bridge has then learnt both addresses
            yield []


class IPv4(Baseline):
    """The kernel's IPv4 forwarding, with static routes and neighbours. Link n is 10.99.n.0/24."""

    def wire(self, chain: Chain, size: int) -> Wire:
        """Return IPv4 frames of ``size`` bytes, Ethernet header included."""
        nodes, last = chain.nodes, len(chain.nodes) - 1
        source, sink = chain.mac(nodes[0], nodes[1]), chain.mac(nodes[-1], nodes[-2])
        far, near = f"10.99.{last}.2", "10.99.1.1"
        return Wire(
            _IPV4,
            ip_frame(chain.mac(nodes[1], nodes[0]) + source, size, far, near),
            ip_frame(chain.mac(nodes[-2], nodes[-1]) + sink, size, near, far),
        )

    @contextmanager
    def stand(self, chain: Chain) -> Iterator[list[LabProcess]]:
        """Make every middle a router."""
        with ExitStack() as undo:
            for at, node in enumerate(chain.middles, 1):
                undo.callback(chain.inside, node, partial(_clear_addresses, chain.devices(node)))
                chain.inside(node, partial(_route, chain, node, at))
            yield []


def _gdp_wire(chain: Chain, size: int, first: bytes, last: bytes) -> Wire:
    """Return GDP frames; the source sends to the address ``first``, the sink to ``last``."""
    nodes = chain.nodes
    source, sink = chain.mac(nodes[0], nodes[1]), chain.mac(nodes[-1], nodes[-2])
    out, back = gdp_frame(first + source, size, SINK, SOURCE), gdp_frame(last + sink, size, SOURCE, SINK)
    return Wire(ETHERTYPE, out, back)


@contextmanager
def _links() -> Iterator[tuple[IPRoute, dict[str, int]]]:
    with IPRoute() as ipr:
        yield ipr, {link.get("ifname"): link["index"] for link in ipr.get_links()}


def _remove_bridge() -> None:
    with _links() as (ipr, index):
        if _BRIDGE in index:
            ipr.link("del", index=index[_BRIDGE])


def _route(chain: Chain, node: str, at: int) -> None:
    """Make the ``at``-th middle a router: its left link has number ``at``, its right one the next."""
    (_IP_SETTINGS / "ip_forward").write_text("1", encoding="ascii")
    for scope in ("all", "default", *chain.devices(node)):
        (_IP_SETTINGS / "conf" / scope / "rp_filter").write_text("0", encoding="ascii")
    left, right = chain.devices(node)
    last = len(chain.nodes) - 1
    with _links() as (ipr, index):
        for device, own, other, ways in (
            (left, f"10.99.{at}.2", f"10.99.{at}.1", range(1, at)),
            (right, f"10.99.{at + 1}.1", f"10.99.{at + 1}.2", range(at + 2, last + 1)),
        ):
            is_end = device in (chain.nodes[0], chain.nodes[-1])
            mac = _ABSENT if is_end else chain.mac(device, node).hex(":")
            ipr.addr("add", index=index[device], address=own, prefixlen=24)
            ipr.neigh("add", dst=other, lladdr=mac, ifindex=index[device], state="permanent")
            for link in ways:
                ipr.route("add", dst=f"10.99.{link}.0/24", gateway=other)


def _clear_addresses(devices: list[str]) -> None:
    """Remove the addresses, and with them routes and neighbours."""
    (_IP_SETTINGS / "ip_forward").write_text("0", encoding="ascii")
    with _links() as (ipr, index):
        for neighbour in ipr.get_neighbours(family=AF_INET):
            ipr.neigh("del", dst=neighbour.get("dst"), ifindex=neighbour["ifindex"])
        for device in devices:
            ipr.flush_addr(index=index[device])
