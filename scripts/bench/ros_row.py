"""Row of the benches with real ROS nodes: A and B, a proxy at either end, switches between, and a cable from A to B.

I/O. Makes namespaces and keys, and starts the commands that robots run.
::

    a -- s1 -- s2 -- s3 -- b      overlay: all switches with the plane ``kernel``, the RIB at s2
    |______________________|      direct: one veth pair with IPv4, which only nodes of the direct case use

With ``bridged`` the direct path is as long as the other one: three more namespaces, each with a Linux bridge::

    a -- p1 -- p2 -- p3 -- b      direct

The overlay may be the ring with its three trust domains instead, of which A is nuc1 and B is nuc5. Else A and B have a
processor each, as two machines have: Linux lets the sender's frames wake the far proxy on the sender's processor.

A node is started ``direct`` or not. Direct nodes meet over the cable, in a ROS domain of their own. The others have a
domain for each end, so that nothing but the proxies joins them, and reach their proxy inside their namespace.
A and B have a ``/dev/shm`` each. So the nodes and the proxy of one machine share memory, as Fast DDS does on a robot,
and between the machines it uses UDP over IPv4. Socket buffers (as far as ``net.core.rmem_max`` allows) and shared
memory segments have 4 MiB. The default ones do not hold a camera image, and the middleware's retransmissions would
then dominate the time. ROS 2's guide to tuning recommends the same.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from itertools import pairwise
from typing import Final

from machine import processor_s

from gdp.host.run_registry import Run
from lab.credentials import Carried, Side
from lab.dds import BUFFER_BYTES, ros_environment
from lab.machines import BenchNodes, Lab
from lab.process import LabProcess, UndoneOnExit
from lab.topology import LEFT, MIDDLE, RIGHT, ROW, DomainPlan, Link, Topology, flat_topology

READY_S: Final = 30.0
_BRIDGES: Final = ("p1", "p2", "p3")
_ADDRESSES: Final = {LEFT: "10.98.0.1", RIGHT: "10.98.0.2"}
_DOMAINS: Final = {LEFT: 141, RIGHT: 142}
DIRECT_DOMAIN: Final = 143
_BRIDGE: Final = "bridge"


class Row(UndoneOnExit):
    """The row with switches, RIBs and proxies running; a context manager that ends them.

    Args:
        run: of which the namespaces are.
        carried: what the proxies carry, by the location of its publishers, or its server.
        mtu: of every device, the cable included; that of the ring is its own.
        bridged: whether the direct path leads through three bridges instead of one cable.
        ring: the overlay in place of the row: A and B are its first and its last switch.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up; also where ROS 2 is not installed.
    """

    def __init__(
        self,
        run: Run,
        carried: Mapping[str, Sequence[Carried]],
        *,
        mtu: int,
        bridged: bool = False,
        ring: Topology | None = None,
    ) -> None:
        overlay = ring or flat_topology(pairwise(ROW), mtu=mtu, rib="s2", members=(LEFT, RIGHT))
        switches = ring.nodes if ring else MIDDLE
        self._machines = dict(zip((LEFT, RIGHT), (at.switch for at in overlay.attached("proxy")), strict=True))
        bridges = _BRIDGES if bridged else ()
        direct = (self._machines[LEFT], *bridges, self._machines[RIGHT])
        cables = tuple(Link(a, b, mtu=mtu) for a, b in pairwise(direct))
        domains = (*overlay.domains, *([DomainPlan("direct", bridges)] if bridges else []))
        topology = Topology((*overlay.links, *cables), domains, overlay.attachments)
        self._lab = Lab(run, topology, own_shared_memory=tuple(self._machines.values()))
        for before, node, after in zip(direct, direct[1:-1], direct[2:], strict=False):
            self._lab.namespaces[node].bridge(_BRIDGE, (before, after))
        for side, device in ((LEFT, direct[1]), (RIGHT, direct[-2])):
            self._lab.namespaces[self._machines[side]].configure([f"addr add {_ADDRESSES[side]}/24 dev {device}"])
        cores = sorted(os.sched_getaffinity(0)) if ring is None else []
        self._cores = {LEFT: cores[:1], RIGHT: cores[-1:]}
        with ExitStack() as undo:
            nodes = BenchNodes(self._lab, switches, plane="kernel", ready_s=READY_S, overlay=overlay)
            self._nodes = undo.enter_context(nodes)
            proxies = []
            for side in self._machines:
                argv = ["-m", "proxy.cli.proxy", "--config", self._admit(side, carried)]
                proxies.append(undo.enter_context(self._start(side, "proxy", argv, self._environment(_DOMAINS[side]))))
            for proxy in proxies:
                proxy.read_line(READY_S)
            self._proxies = [each.pid for each in proxies]
            self._undo = undo.pop_all()

    def node(self, side: str, module: str, role: str, *, direct: bool, **settings: object) -> LabProcess:
        """Start a ROS node at A or B: ``python -m module role settings``."""
        return self.process(side, role, ["-m", module, role, json.dumps(settings)], direct=direct)

    def process(self, side: str, what: str, arguments: Sequence[str], *, direct: bool) -> LabProcess:
        """Start a Python process with a ROS node at A or B."""
        environment = self._environment(DIRECT_DOMAIN if direct else _DOMAINS[side])
        return self._start(side, what, arguments, [*environment, f"CYCLONEDDS_URI={_cyclone(side)}"])

    def _start(self, side: str, what: str, arguments: Sequence[str], environment: Sequence[str]) -> LabProcess:
        started = self._lab.start(self._machines[side], what, arguments, environment)
        if self._cores[side]:
            os.sched_setaffinity(started.pid, self._cores[side])
        return started

    def proxies_cpu_s(self) -> float:
        """Return the processor time that both proxies have used."""
        return sum(processor_s(pid) for pid in self._proxies)

    def _environment(self, domain: int) -> list[str]:
        return ros_environment(self._nodes.files, domain, shared_memory=True)

    def _admit(self, side: str, carried: Mapping[str, Sequence[Carried]]) -> str:
        """Give a proxy the delegations of its side, and write its configuration; return the file."""
        sides: dict[Side, Sequence[Carried]] = {
            "expose" if source == side else "import": names for source, names in carried.items()
        }
        return self._nodes.admit_proxy(self._machines[side], _DOMAINS[side], sides)


def _cyclone(side: str) -> str:
    """Return the configuration of Cyclone DDS for a direct node: interface, and socket buffers as the others have."""
    return (
        f'<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="{_ADDRESSES[side]}"/>'
        f'</Interfaces></General><Internal><SocketReceiveBufferSize max="{BUFFER_BYTES}B"/></Internal></Domain>'
        "</CycloneDDS>"
    )
