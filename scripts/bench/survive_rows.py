"""Events of ``survive.py``: a small network for each, what fails in it, and how that is undone.

I/O. Through ``faults.overlay``. P publishes to R at an even rate; ``-`` is a link of cost 10, ``=`` one of
12, so that traffic takes the upper way::

    square      P - s1 - s2 - s4 - R            all of one domain; s1 has a loop-free alternate to s4 by s3 (RFC 5286),
                     \\= s3 -/                    s2 has none: the way from its other neighbour leads back over s2
    borders     P - a1 - a2 - b2 - b1 - R       two domains, two borders each
                     \\= a3 - b3 =/
    star        P - a1 - t1 - c1 - R            a domain each (a, b, t, c, d), RIBs in all of them; P and R may be moved
                    b1 -/  \\- d1                to b1 and d1, or in the domain from a1 to a2 (which hangs at a1)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Final

from faults.overlay import Overlay
from faults.plan import Flow, Plan

from gdp.host.run_registry import Run
from gdp.trust.right import Right
from lab.faults import Fault, FaultKind
from lab.internet.access import Access
from lab.internet.flow import NumberedFlow, open_sessions
from lab.internet.host import Host
from lab.internet.laboratory import Laboratory
from lab.internet.site import Site
from lab.namespaces import received
from lab.process import until
from lab.topology import Link, ends_of, make_topology

CUT, KILL = FaultKind.CUT, FaultKind.KILL_SWITCH
TOPIC: Final = "/steady"
NEW_TOPICS: Final = 40
_DEARER: Final = 12
_TUNNEL_S: Final = 40.0
_COUNT_S: Final = 0.1  # time of counting frames, to find the flow's path


@dataclass(frozen=True, slots=True)
class Row:
    """One event.

    Args:
        what: in words.
        target_s: most seconds of silence at the 99th percentile; None: reported without a target.
        plan: the network, for a rate of messages a second.
        fail: makes the event happen; gets the overlay and the number of the round, from 0. Faults that it leaves are
            undone; without one, the next event starts from this state.
        new_name_s: most seconds until a new name is read; None: not measured.
        holds: the event lasts for ``DEAD_S`` of the bench.
    """

    what: str
    target_s: float | None
    plan: Callable[[float], Plan]
    fail: Callable[[Overlay, int], None]
    new_name_s: float | None = None
    holds: bool = False

    @property
    def new_name(self) -> str:
        """Return the label of the figures of a new name."""
        return f"{self.what}: until a new name is read"


def _flows(hz: float) -> tuple[Flow, ...]:
    return (Flow(TOPIC, "P", ("R",), hz=hz),)


def _square(hz: float, ribs: tuple[str, ...] = ("s3",), *, new_names: bool = False) -> Plan:
    topology, members = make_topology(
        {"home": ("s1", "s2", "s3", "s4")},
        {},
        ("s1-s2", "s2-s4", Link("s1", "s3", cost=_DEARER), "s3-s4"),
        ribs,
        {"P": "s1", "R": "s4"},
    )
    new = (Flow(f"/new/{n}", "P", ("R",), hz=50.0, waits=True) for n in range(NEW_TOPICS if new_names else 0))
    return Plan(topology, members, flows=(*_flows(hz), *new))


def _borders(hz: float) -> Plan:
    topology, members = make_topology(
        {"a": ("a1", "a2", "a3"), "b": ("b1", "b2", "b3")},
        {"b": "a"},
        ("a1-a2", "a2-b2", "b2-b1", Link("a1", "a3", cost=_DEARER), "a3-b3", Link("b3", "b1", cost=_DEARER)),
        ("a1", "b1"),
        {"P": "a1", "R": "b1"},
    )
    return Plan(topology, members, flows=_flows(hz))


def _star(hz: float, homes: Mapping[str, tuple[str, ...]]) -> Plan:
    topology, members = make_topology(
        {"t": ("t1",), "a": ("a1", "a2"), "b": ("b1",), "c": ("c1",), "d": ("d1",)},
        {"a": "t", "b": "t", "c": "t", "d": "t"},
        ("a1-t1", "a2-a1", "b1-t1", "c1-t1", "d1-t1"),
        ("t1", "a1", "b1", "c1", "d1"),
        {"P": "a1", "R": "c1"},
    )
    return Plan(topology, members, homes=homes, flows=_flows(hz))


def _own_switch(hz: float) -> Plan:
    topology, members = make_topology(
        {"t": ("t1",), "a": ("a1", "robot"), "b": ("b1",), "c": ("c1",)},
        {"a": "t", "b": "t", "c": "t"},
        ("a1-t1", "robot-a1", "b1-t1", "c1-t1"),
        ("t1", "a1", "b1", "c1"),
        {"P": "robot", "R": "c1"},
    )
    return Plan(topology, members, homes={"robot": ("a1", "b1")}, flows=_flows(hz))


def _move(*movers: str) -> Callable[[Overlay, int], None]:
    def move(overlay: Overlay, at: int) -> None:
        for mover in movers:
            homes = overlay.plan.homes[mover]
            overlay.move(mover, homes[(at + 1) % len(homes)])

    return move


def _on_path(kind: FaultKind, last: str = "s4", **ways: str) -> Callable[[Overlay, int], None]:
    """Return what breaks the switch, or the link to or from it, that the flow uses at that moment.

    A link that came back may be left out of routes for seconds (damping), so the path is not always the cheaper one.
    The busier of the last switch's two devices shows the path.

    Args:
        kind: of the fault.
        last: the switch where both paths meet again.
        ways: the switch before it on the flow's path, and what fails then.
    """

    def fail(overlay: Overlay, _: int) -> None:
        space, frames = overlay.spaces[last], partial(received, list(ways))
        before = space.inside(frames)
        time.sleep(_COUNT_S)
        after = space.inside(frames)
        failed = ways[max(ways, key=lambda way: after[way] - before[way])]
        overlay.begin(Fault(kind, (failed,) if kind is FaultKind.KILL_SWITCH else ends_of(failed), 0.0))

    return fail


def _kill_one_rib(overlay: Overlay, at: int) -> None:
    ribs = overlay.plan.ribs
    overlay.begin(Fault(FaultKind.KILL_RIB, (f"rib {ribs[at % len(ribs)]}",), 0.0))


def _kill_all_ribs(overlay: Overlay, _: int) -> None:
    for at in range(len(overlay.plan.ribs)):
        _kill_one_rib(overlay, at)


def _two_ribs(hz: float) -> Plan:
    return _square(hz, ("s3", "s2"), new_names=True)


ROWS: Final[dict[str, Row]] = {
    "nothing": Row("nothing happens", None, _square, lambda *_: None),
    "roam-domain": Row("roaming, same domain", 0.3, lambda hz: _star(hz, {"P": ("a1", "a2")}), _move("P")),
    "roam-other": Row("roaming, other domain", 0.5, lambda hz: _star(hz, {"P": ("a1", "b1")}), _move("P")),
    "roam-switch": Row("roaming, own switch", 0.5, _own_switch, _move("robot")),
    "roam-both": Row(
        "roaming, both ends at once", 0.8, lambda hz: _star(hz, {"P": ("a1", "b1"), "R": ("c1", "d1")}), _move("P", "R")
    ),
    "cut-alternate": Row(
        "link cut, carrier seen, with an alternate", 0.005, _square, _on_path(CUT, s2="s1-s2", s3="s1-s3")
    ),
    "cut": Row("link cut, carrier seen, without an alternate", 0.05, _square, _on_path(CUT, s2="s2-s4", s3="s3-s4")),
    "silent": Row("link cut, silent", 0.25, _square, _on_path(FaultKind.SILENT, s2="s1-s2", s3="s1-s3")),
    "switch": Row("switch on the path killed", 0.3, _square, _on_path(KILL, s2="switch s2", s3="switch s3")),
    "border": Row("border killed", 0.5, _borders, _on_path(KILL, "b1", b2="switch a2", b3="switch a3")),
    "rib": Row("any one RIB of two killed", 0.0, _two_ribs, _kill_one_rib, new_name_s=0.3),
    "ribs": Row("all RIBs dead", 0.0, _two_ribs, _kill_all_ribs, holds=True),
}


def roaming_flow(run: Run, stack: ExitStack) -> tuple[Host, list[Site], NumberedFlow]:
    """Return a robot, the sites of its homes, and its flow to a server through a direct tunnel."""
    laboratory = stack.enter_context(Laboratory(run))
    homes = [laboratory.add_site(f"home{number}", Access.PORT_RESTRICTED) for number in (1, 2)]
    robot = laboratory.add_host("robot", homes[0])
    rights = [{TOPIC: [Right.PUBLISH]}, {TOPIC: [Right.READ]}]
    overlay, server, (sender, reader) = open_sessions(robot, stack, rights)
    subscription, publisher = reader.subscribe(TOPIC), sender.publisher(TOPIC)
    publisher.wait_for_readers(timeout_s=_TUNNEL_S)
    until(lambda: overlay.tunnels(robot).get(server.label, {}).get("up"), lambda: "a direct tunnel", _TUNNEL_S)
    return robot, homes, NumberedFlow(publisher, subscription)


ADDRESS_CHANGES: Final[dict[str, Callable[[Host, Sequence[Site]], object]]] = {
    "nothing": lambda *_: None,
    "another address in the same network": lambda robot, _: robot.renumber(),
    "another network": lambda robot, homes: robot.attach(homes[robot.site() is homes[0]]),
    "another public address": lambda robot, _: robot.site().renumber(),
    "the NAT forgets its mappings": lambda robot, _: robot.site().flush_mappings(),
}
