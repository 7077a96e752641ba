"""Thin link between two namespaces, as the bench owns it: devices without offloads, a relay, and its reports.

I/O. Starts a process in the namespace between robot and cloud.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Final

from gdp.host.run_registry import Run
from lab.machines import Lab
from lab.namespaces import clear_offloads, mac_addresses
from lab.process import FailedError, LabProcess
from lab.topology import flat_topology
from thin_link.channel import Flow
from thin_link.conditions import FRAME_BYTES, Conditions

ROBOT: Final = "s1"
CLOUD: Final = "s2"
LINE: Final = "line"
TCP_CONTROL: Final = "cubic"  # a machine's own default may differ from Linux's
ADDRESSES: Final = {ROBOT: "10.99.0.1", CLOUD: "10.99.0.2"}
_INSIDE: Final = (("a", ROBOT), (ROBOT, LINE), (LINE, CLOUD), (CLOUD, "b"))
_READY_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Used:
    """Use of a link over a span, and how exact its relay was: lateness of frames, p99 in ms."""

    up: Flow
    down: Flow
    late_ms: float


class Line:
    """Running relay."""

    def __init__(self, process: LabProcess) -> None:
        self._process = process

    def rewind(self) -> None:
        """Begin recording and losses again: every system meets the same link from here on."""
        self._ask(rewind=True)

    def begin(self) -> None:
        """Begin a span."""
        self._ask()

    def end(self) -> Used:
        """Return the use of the link since ``begin``.

        Raises ``FailedError``: the relay lost a frame itself, so that the figures would mean nothing.
        """
        said = self._ask()
        for what in ("oversized", "refused", "kernel_drops"):
            if said[what]:
                raise FailedError(f"the relay of the link had {said[what]} frames {what}")
        return Used(Flow(**said["up"]), Flow(**said["down"]), said["late_us"] / 1e3)

    def _ask(self, **order: bool) -> dict[str, Any]:
        return self._process.ask(report=True, **order)


def thin_link_lab(run: Run) -> Lab:
    """Make the machines ``a - s1 - line - s2 - b``: programs and switch of the robot, the link, those of the cloud.

    Raises ``LocalError``: the kernel refuses. Raises ``FailedError``: it has no such congestion control.
    """
    topology = flat_topology(
        _INSIDE, mtu=FRAME_BYTES, rib=CLOUD, members=("a", "b"), switches=("a", ROBOT, LINE, CLOUD, "b")
    )
    lab = Lab(run, topology)
    for node, address in ADDRESSES.items():
        lab.namespaces[node].configure([f"addr add {address}/24 dev {LINE}"])
        _set_tcp_control(lab, node)
        lab.inside(node, partial(clear_offloads, LINE))
        lab.inside(LINE, partial(clear_offloads, node))
    macs = {node: lab.inside(node, partial(mac_addresses, [LINE]))[LINE] for node in ADDRESSES}
    for node, other in ((ROBOT, CLOUD), (CLOUD, ROBOT)):
        far = f"{ADDRESSES[other]} lladdr {macs[other].hex(':')}"
        lab.namespaces[node].configure([f"neigh add {far} dev {LINE} nud permanent"])  # no ARP crosses the link
    return lab


def _set_tcp_control(lab: Lab, node: str) -> None:
    """Set the congestion control on the route: only a route may name one that the first namespace does not offer all.

    Source: Linux, net/ipv4/tcp_cong.c, ``tcp_set_default_congestion_control``.
    """
    route = f"10.99.0.0/24 dev {LINE} proto kernel scope link src {ADDRESSES[node]} congctl {TCP_CONTROL}"
    lab.machines[node].output("ip", "route", "replace", *route.split())


@contextmanager
def open_line(
    lab: Lab, conditions: Conditions, line: str = LINE, ends: tuple[str, str] = (ROBOT, CLOUD)
) -> Iterator[Line]:
    """Run the relay of a link at ``line``, between the machines at its ends, until the context ends."""
    path = lab.directory / f"{line}.json"
    settings = {
        "devices": ends,
        "up": asdict(conditions.up),
        "down": asdict(conditions.down),
        "seed": conditions.seed,
    }
    path.write_text(json.dumps(settings), encoding="ascii")
    with lab.start(line, "relay", ["-m", "thin_link.relay", str(path)], has_orders=True) as process:
        process.read(_READY_S)
        yield Line(process)
