"""Systems of the uplink bench: the processes of each on the machines of robot and cloud, ready for the traffic.

I/O. Starts processes; a context manager ends them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from typing import Any, Final

from peers.certificates import make_certificates
from report import progress

from gdp.trust.right import Right
from lab.machines import BenchNodes, Lab
from lab.process import Event, LabProcess
from thin_link.line import ADDRESSES, CLOUD, ROBOT, Line, Used
from thin_link.traffic import streams

_READY_S: Final = 45.0
_DRAIN_S: Final = 2.5
_MODULE: Final = "uplink_endpoint"
_PORT: Final = 7_447

Ends = tuple[LabProcess, LabProcess]


def start_role(lab: Lab, node: str, role: str, settings: Mapping[str, Any], *, has_orders: bool = False) -> LabProcess:
    """Start a role of the endpoint process."""
    return lab.start(node, role, ["-m", _MODULE, role, json.dumps(settings)], has_orders=has_orders)


def run_window(
    lines: Sequence[Line], ends: Sequence[LabProcess], seconds: float, warm_up_s: float = 3.0
) -> tuple[list[Used], list[Event]]:
    """Let ends exchange their traffic; return the use of each link in a window, and what each end says of it.

    Raises ``FailedError``: a process ended, or a relay lost a frame itself.
    """
    for line in lines:
        line.rewind()
    start_ns = time.monotonic_ns() + 50_000_000
    begin_ns = start_ns + round(warm_up_s * 1e9)
    end_ns = begin_ns + round(seconds * 1e9)
    for end in ends:
        end.tell(start_ns=start_ns, begin_ns=begin_ns, end_ns=end_ns, drained_ns=end_ns + round(_DRAIN_S * 1e9))
    time.sleep((begin_ns - time.monotonic_ns()) / 1e9)
    for line in lines:
        line.begin()
    time.sleep((end_ns - time.monotonic_ns()) / 1e9)
    used = [line.end() for line in lines]
    said = [end.read(_READY_S) for end in ends]
    if refusals := [each["refusals"] for each in said if each["refusals"]]:
        progress(f"refused: {refusals}")
    return used, said


@contextmanager
def started(
    lab: Lab, system: str, camera: str, ends: Iterable[tuple[str, str, Mapping[str, Any]]]
) -> Iterator[list[LabProcess]]:
    """Start ends, each by its machine, role and own settings, and wait until they are matched."""
    with ExitStack() as stack:
        made = []
        for node, role, own in ends:
            settings = {"system": system, "camera": camera, "own": own}
            made.append(stack.enter_context(start_role(lab, node, role, settings, has_orders=True)))
        for end in made:
            end.read(_READY_S)
        yield made


@contextmanager
def _gdp(lab: Lab, camera: str) -> Iterator[Ends]:
    """Switches at robot and cloud, the RIB at the cloud, and a session of the library at either."""
    mix = streams(camera)
    up = [each.name for each in mix if each.direction == "up"]
    down = [each.name for each in mix if each.direction == "down"]
    rights = {
        ("a", "robot"): {Right.PUBLISH: up, Right.READ: down},
        ("b", "cloud"): {Right.PUBLISH: down, Right.READ: up},
    }
    with BenchNodes(lab, (ROBOT, CLOUD), plane="kernel") as nodes:
        ends = [(*each, {"config": str(nodes.admit_member(each[0], granted))}) for each, granted in rights.items()]
        with started(lab, "gdp", camera, reversed(ends)) as (cloud, robot):
            yield robot, cloud


@contextmanager
def _zenoh(scheme: str, congestion: str, lab: Lab, camera: str) -> Iterator[Ends]:
    """Two peers over one link with mutual TLS, of TCP or of QUIC."""
    directory, at = lab.directory / "tls", f"{scheme}/{ADDRESSES[CLOUD]}:{_PORT}"
    make_certificates(directory, {node: [address] for node, address in ADDRESSES.items()})
    ends = [
        (node, role, {"certificate": str(directory / node), "congestion": congestion, key: [at]})
        for node, role, key in ((CLOUD, "cloud", "listen"), (ROBOT, "robot", "connect"))
    ]
    with started(lab, "zenoh", camera, ends) as (cloud, robot):
        yield robot, cloud


System = Callable[[Lab, str], AbstractContextManager[Ends]]
"""Runs both ends, robot first, matched and waiting for a window; raises FailedError if one did not come up."""
SYSTEMS: Final[Mapping[str, System]] = {
    "gdp": _gdp,
    **{
        f"zenoh-{scheme}-{what}": partial(_zenoh, scheme, what)
        for scheme in ("tls", "quic")
        for what in ("drop", "block")
    },
}
