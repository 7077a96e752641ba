"""Scenario of the demonstration: machines join the domain of one of them, traffic flows, and networks change under it.

I/O. Each step may be shown by a ``Display``. ::

    robot   wlan0 -- home, port-restricted NAT ----+
            wwan0 -- 5G, symmetric NAT ------------+-- internet -- cloud-b, public: border, RIB, enrolment
    cloud-a ------- provider, port-restricted NAT -+
    edge    ------- office, IPv6 only -------------+
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from gdp.trust.right import Right
from internet_demo.traffic import CAMERA, PLAN, Traffic
from lab.command import StepDisplay
from lab.internet.access import Access
from lab.internet.host import Host
from lab.internet.laboratory import Laboratory
from lab.internet.overlay import Link, Overlay
from lab.internet.site import Site

WIFI: Final = "wlan0"
WWAN: Final = "wwan0"
_PLAIN_EVERY_S: Final = 2.5
_WAYS: Final = (("direct", True), ("border", False))


class Stage(Overlay):
    """Networks, and machines with their programs.

    ``delay_ms``: of each uplink, in each direction; 0: none, and no process for it.
    """

    def __init__(self, laboratory: Laboratory, delay_ms: float) -> None:
        self._laboratory, self._delay_ms = laboratory, delay_ms
        self.cloud_b = laboratory.add_host("cloud-b", self.add_site("dc", Access.PUBLIC))
        super().__init__(laboratory, self.cloud_b)
        self._add_members()

    def _add_members(self) -> None:
        """Make the machines that join."""
        self.home, self.mobile = self.add_site("home", Access.PORT_RESTRICTED), self.add_site("5g", Access.SYMMETRIC)
        self.robot = self._laboratory.add_host("robot", self.home, WIFI)
        self.robot.attach(self.mobile, WWAN)
        self.cloud_a = self._laboratory.add_host("cloud-a", self.add_site("provider", Access.PORT_RESTRICTED))
        self.edge = self._laboratory.add_host("edge", self.add_site("office", Access.IPV6_ONLY))

    def add_site(self, label: str, access: Access) -> Site:
        """Attach one more network."""
        return self._laboratory.add_site(label, access, delay_ms=self._delay_ms)


class Display(StepDisplay):
    """Display of steps, machines and counts."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, is_kept=False, plain_every_s=_PLAIN_EVERY_S)

    def show(self, machines: Iterable[Host], links: Mapping[str, Sequence[Link]], traffic: Traffic) -> None:
        """Show the present state; plain lines appear every few seconds."""
        counts = _counts(traffic)
        self._show(_page(machines, links, counts), Text(f"{counts}; {_ways(links.get('robot', ()))}"))


def _counts(traffic: Traffic) -> str:
    got = ", ".join(f"{label} {count}" for label, count in traffic.counts.items())
    calls = traffic.calls
    return f"{len(traffic.images.sent_s)} images ({got}), {calls.answered} of {calls.begun} calls"


def _ways(tunnels: Sequence[Link]) -> str:
    """Return which peers are joined directly and which are borders, each once."""
    peers = {way: sorted({each.peer for each in tunnels if each.is_direct is is_direct}) for way, is_direct in _WAYS}
    return "; ".join(f"{way} {', '.join(found)}" for way, found in peers.items() if found) or "no tunnel"


def _page(machines: Iterable[Host], links: Mapping[str, Sequence[Link]], counts: str) -> RenderableType:
    table = Table("machine", "device", "network", "address", "public address", "tunnels")
    for machine in machines:
        tunnels = "\n".join(
            f"{each.peer} {'direct' if each.is_direct else 'border'} {each.endpoint}"
            for each in links.get(machine.label, ())
        )
        for number, device in enumerate(machine.devices):
            site, lease = machine.site(device), machine.lease(device)
            address = (lease.address or lease.address6).partition("/")[0]
            first = machine.label if number == 0 else ""
            public = site.address or address
            state = " (cut)" if site.is_cut else ""
            table.add_row(first, device, f"{site.label}, {site.access.value}{state}", address, public, tunnels)
            tunnels = ""
    return Group(table, Text(counts))


_LOOK_S: Final = 0.25
_READERS: Final = ("cloud-a", "edge")


@dataclass(frozen=True, slots=True)
class Pace:
    """Pace of the demonstration. ``calm_s``: after each event. ``delay_ms``: of each uplink, in each direction."""

    rate_hz: float = 20.0
    image_bytes: int = 20_000
    calm_s: float = 5.0
    delay_ms: float = 5.0


@dataclass(frozen=True, slots=True)
class Event:
    """An event, and the longest pause between two images at any reader from then until the next one."""

    text: str
    pause_s: float


@dataclass(slots=True)
class Outcome:
    """What the demonstration came to."""

    images: int = 0
    calls: int = 0
    lost: int = 0
    doubled: int = 0
    joined_s: float = 0.0
    typed: list[str] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    drawing: list[str] = field(default_factory=list)


def run_scenario(laboratory: Laboratory, pace: Pace, display: Display) -> Outcome:
    """Play the demonstration. Raises ``LocalError``: a machine does not join, or a program does not start."""
    outcome = Outcome()
    display.step("networks: home and 5G for the robot, a provider's NAT, a public cloud, an office on IPv6 only")
    stage = Stage(laboratory, pace.delay_ms)
    with ExitStack() as stack:
        begun_s = time.monotonic()
        hosts = (stage.robot, stage.cloud_a, stage.edge)
        stage.stand_up(*hosts, options={"robot": (f"--uplink={WIFI}", f"--uplink={WWAN}")})
        outcome.typed = stage.typed
        for command in stage.typed:
            display.step(f"typed at {command}")
        stage.wait_until_joined()
        outcome.joined_s = time.monotonic() - begun_s
        display.step(f"all machines have joined after {outcome.joined_s:.1f} s")
        stage.grant(
            {
                "robot": {CAMERA: [Right.PUBLISH], PLAN: [Right.CALL]},
                "cloud-a": {CAMERA: [Right.READ], PLAN: [Right.SERVE]},
                "edge": {CAMERA: [Right.READ]},
            }
        )
        sessions = {
            label: stack.enter_context(stage.open_session(stage.machines[label])) for label in ("robot", *_READERS)
        }
        readers = {label: sessions[label] for label in _READERS}
        traffic = Traffic(sessions["robot"], sessions["cloud-a"], readers, pace.rate_hz, pace.image_bytes)
        try:
            for text, act in _events(stage):
                since_s = time.monotonic()
                display.step(text)
                act()
                _watch(stage, traffic, display, pace.calm_s)
                outcome.events.append(Event(text, traffic.images.silence_ms(since_s, time.monotonic()) / 1e3))
        finally:
            traffic.end()
        outcome.images, outcome.calls, outcome.lost = len(traffic.images.sent_s), traffic.calls.begun, traffic.lost
        outcome.doubled = traffic.images.doubled
        outcome.reasons = list(traffic.calls.reasons)
    return outcome


def _events(stage: Stage) -> list[tuple[str, Callable[[], None]]]:
    cafe = stage.add_site("cafe", Access.FULL_CONE)
    return [
        ("images and calls cross", lambda: None),
        ("the provider gives the robot's home another address", stage.home.renumber),
        ("the robot's Wi-Fi moves to another network", lambda: stage.robot.attach(cafe, WIFI)),
        ("the NAT of the 5G network forgets its mappings", stage.mobile.flush_mappings),
        ("the NAT of cloud A forgets its mappings", stage.cloud_a.site().flush_mappings),
        ("the robot's Wi-Fi uplink is cut: packets vanish", cafe.cut),
    ]


def _watch(stage: Stage, traffic: Traffic, display: Display, seconds: float) -> None:
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        links = {label: stage.links(machine) for label, machine in stage.machines.items()}
        display.show(stage.machines.values(), links, traffic)
        time.sleep(_LOOK_S)
