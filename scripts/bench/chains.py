"""Chain of namespaces for the forwarding bench: a source, some switches, a sink, each in its own.

I/O. ``lab.namespaces`` makes and removes the namespaces. ``baselines.py`` defines the switches.
::

    s1 (source) -- s2 -- ... -- s(n+1) -- s(n+2) (sink)        a device has the name of the neighbour it leads to
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Final

from frames import Wire
from machine import offloads, soft_interrupts_s, thread_s
from rate_search import Try
from testbed import Lab, mac_addresses, set_link

from gdp.host.run_registry import RunRegistry
from lab.process import LabProcess, figures_of, floats_of
from lab.topology import chain

ROLES: Final = Path(__file__).with_name("roles.py")
_SOURCE_CPU, _SINK_CPU = 0, 1
_READY_S: Final = 120.0


class Chain(Lab):
    """Chain with ``switches`` switches, none of which runs yet; a context manager that removes all of it.

    Args:
        runs: location of the record of what is made.
        switches: 0 joins the source and the sink directly.
        mtu: bytes after the Ethernet header.

    Attributes:
        roles: script of the processes; another commit's while its packages are measured.

    Raises:
        LocalError: the kernel refuses.
    """

    def __init__(self, runs: RunRegistry, switches: int, mtu: int) -> None:
        self.switches = switches
        self.roles = ROLES
        self._undo = ExitStack()
        with ExitStack() as undo:
            run = runs.start()
            undo.callback(run.end)
            super().__init__(run, chain(switches + 2, mtu))
            self.nodes = self.topology.nodes
            self._macs = {node: self.inside(node, partial(mac_addresses, self.devices(node))) for node in self.nodes}
            self._source, self._sink = (
                undo.enter_context(self.worker(node, "end", cpu=cpu, ifname=self.devices(node)[0]))
                for node, cpu in ((self.nodes[0], _SOURCE_CPU), (self.nodes[-1], _SINK_CPU))
            )
            self._source.read(_READY_S)
            self._sink.read(_READY_S)
            self._undo = undo.pop_all()

    def __enter__(self) -> Chain:
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def worker(self, node: str, role: str, *, cpu: int | None = None, **settings: object) -> LabProcess:
        """Start a role of ``roles.py``; ``cpu``: the core to run on, None: any."""
        orders = json.dumps({"role": role, "cpu": cpu, **settings})
        return self.start(node, role, [str(self.roles), orders], has_orders=True)

    @property
    def middles(self) -> Sequence[str]:
        """The nodes between the source and the sink."""
        return self.nodes[1:-1]

    def devices(self, node: str) -> list[str]:
        """Return a node's devices, from left to right."""
        at = self.nodes.index(node)
        return [*self.nodes[max(0, at - 1) : at], *self.nodes[at + 1 : at + 2]]

    def mac(self, node: str, towards: str) -> bytes:
        """Return the address of a node's device towards a neighbour."""
        return self._macs[node][towards]

    def set_mtu(self, mtu: int) -> None:
        """Set the MTU of every device, in bytes."""
        for node in self.nodes:
            for device in self.devices(node):
                self.inside(node, partial(set_link, device, mtu=mtu))

    def offloads(self) -> list[dict[str, bool]]:
        """Return the offloads of every device."""
        return [one for node in self.nodes for one in self.inside(node, partial(_all_offloads, self.devices(node)))]

    def attempt(
        self,
        wire: Wire,
        switches: Sequence[LabProcess],
        rate: float | None,
        seconds: float,
    ) -> Try:
        """Send for a while, at ``rate`` frames/s or flat out, and count.

        ``wire``: what to send. ``switches``: the processes whose time counts. ``rate``: None for flat out. ``seconds``:
        for how long. Raises ``FailedError``: a process of the bench ended.
        """
        self._sink.ask(do="count", ethertype=wire.ethertype)
        spent_s = soft_interrupts_s() + sum(thread_s(each.pid) for each in switches)
        sent = figures_of(self._source.ask(do="send", frame=wire.out.hex(), rate=rate, seconds=seconds))
        got = figures_of(self._sink.ask(expected=sent["sent"]))
        spent_s = soft_interrupts_s() + sum(thread_s(each.pid) for each in switches) - spent_s
        return Try(
            asked=rate,
            sent=int(sent["sent"]),
            got=int(got["got"]),
            sink_drops=int(got["drops"]),
            send_s=sent["end_s"] - sent["start_s"],
            late_s=got["last_s"] - sent["end_s"],
            cpu_s=spent_s + sent["cpu_s"],
        )

    def round_trips(self, wire: Wire, pings: int, *, poll: bool) -> list[float]:
        """Return round-trip times in microseconds; fewer than ``pings`` when some were lost.

        Raises ``FailedError``: a process of the bench ended.
        """
        same = {"ethertype": wire.ethertype, "pings": pings, "poll": poll}
        self._sink.ask(do="answer", frame=wire.back.hex(), **same)
        times = floats_of(self._source.ask(do="ping", frame=wire.out.hex(), **same), "rtt_us")
        self._sink.read(_READY_S)
        return times


def _all_offloads(devices: Sequence[str]) -> list[dict[str, bool]]:
    return [offloads(device) for device in devices]
