"""Random networks and links: what a new reader is owed first arrives at once, whatever was published before it came.

A reader comes before, just after or minutes after the first messages. It is killed while much waits for it, and starts
again, or another one comes in its place. Links are thin, lossy or full; they change their rates, and one is cut. In the
end all is well again, for three leases. A drawn plan prints itself; given back it repeats the run.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Final

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.intervals import READER
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.draws import draws
from tests.journeys.flows import LEASE_S, Flow, advertise
from tests.journeys.networks import SETTLE_S, short_leases

SHAPES: Final = ("chain", "ring", "tree")
JOIN_S: Final = 20.0  # until a publisher knows a reader; other tests limit that
FRAME_BYTES: Final = 1_500
REPAIR_S: Final = 1.0  # of a frame that a link lost, and of its repair
FULL_S: Final = 6.0  # while images fill the path and their queue overflows
SPARE_S: Final = 0.3
TRIES, TRY_S = 6, 0.25
DRAIN_S: Final = 60.0
FILL_BYTES, FILL_HZ, FILL_S = 15_000, 10, 6.0  # more than the thinnest link carries


@dataclass(frozen=True)
class Thin:
    """One link: Mbit/s, one-way ms, loss in per cent, FIFO in ms."""

    mbit_s: float
    ms: int
    loss: int
    fifo_ms: int


@dataclass(frozen=True)
class Plan:
    """Network, what is published before a reader comes, and how it comes.

    Args:
        order: of the names of switches and members; a seed.
        is_full: images share the path while a reader comes.
        reliable: the topic; ``awaits``: its publisher keeps messages for readers that waited before them.
        older: messages before the reader comes, and again before the next; each of ``size`` bytes.
        comes_s: seconds for which these are published before it comes.
        again: how a reader comes next: it is killed, and comes itself (``restart``) or another one does (``other``); it
            says goodbye, and another one comes (``leave``); none does (empty).
        away_s: seconds for which there is no reader.
        cut: the link that is cut meanwhile, modulo all; -1: none.
        rate: by which the rates of links have changed when a reader comes.
    """

    shape: str
    switches: int
    order: int
    links: tuple[Thin, ...]
    is_full: bool
    reliable: bool
    awaits: bool
    older: int
    size: int
    comes_s: float
    again: str
    away_s: float
    cut: int
    rate: float
    seed: int

    def topology(self) -> Topology:
        """Return its topology: the publisher at one end, and the readers at the other."""
        names = [f"s{number}" for number in range(self.switches)]
        random.Random(self.order).shuffle(names)
        if self.shape == "tree":
            ends = [((at - 1) // 2, at) for at in range(1, self.switches)]
        else:
            ends = [(at - 1, at) for at in range(1, self.switches)]
            ends += [(self.switches - 1, 0)] if self.shape == "ring" and self.switches > 2 else []
        first, middle, last = names[0], names[self.switches // 2], names[-1]
        members = [Attachment(last, "proxy", "other"), Attachment(last, "proxy", "reader")]
        members.insert(self.order % 3, Attachment(first, "proxy", "robot"))
        return Topology(
            tuple(Link(names[a], names[b]) for a, b in ends),
            (DomainPlan("home", tuple(sorted(names))),),
            (Attachment(middle, "rib", "rib"), *members),
        )


def plans() -> st.SearchStrategy[Plan]:
    """Draw a plan."""
    link = st.builds(
        Thin,
        st.sampled_from([1.0, 2.0, 8.0]),
        st.sampled_from([1, 5, 20]),
        st.sampled_from([0, 0, 1, 3]),
        st.sampled_from([120, 200, 1_000]),
    )
    return st.builds(
        Plan,
        st.sampled_from(SHAPES),
        st.integers(2, 6),
        st.integers(0, 100),
        st.lists(link, min_size=1, max_size=6).map(tuple),
        st.booleans(),
        st.sampled_from([True, True, False]),
        st.booleans(),
        st.sampled_from([8, 40]),
        st.sampled_from([200, 20_000]),
        st.sampled_from([0.0, 1.0, 130.0]),
        st.sampled_from(["", "restart", "restart", "other", "leave"]),
        st.sampled_from([0.5, 8.0, 70.0]),
        st.integers(-1, 6),
        st.sampled_from([1.0, 0.5, 4.0]),
        st.integers(1, 1_000),
    )


@dataclass
class Trial:
    """One plan, run for three leases after its last reader has come."""

    plan: Plan
    world: Simulation = field(init=False)
    flow: Flow = field(init=False)
    fill: Flow = field(init=False)

    def run(self) -> None:
        """Publish, let the readers come, and check when each gets its first message."""
        plan = self.plan
        self.world = world = Simulation(topology=plan.topology(), seed=plan.seed, lease_s=LEASE_S)
        assert world.run_until_attached(SETTLE_S)
        robot, reader, other = (self._member(each) for each in ("robot", "reader", "other"))
        self._set_links(1.0)
        self.flow, self.fill = (advertise(world, name, robot, reliable=of) for name, of in self._topics())
        if plan.awaits:
            self.flow.publisher.await_readers(world.network.now.mono_s + plan.comes_s + JOIN_S)
        self.flow.stream(plan.older, plan.comes_s / plan.older, plan.size)
        world.network.run(plan.comes_s)
        self._meet(reader)
        last = self._meet_next(reader, other) if plan.again else reader
        self._end(last)

    def _topics(self) -> tuple[tuple[str, bool], tuple[str, bool]]:
        return ("/scan", self.plan.reliable), ("/image", False)

    def _member(self, label: str) -> str:
        return next(each for each in self.world.members if each.endswith(f"/{label}"))

    @property
    def _cables(self) -> list[SimLink]:
        return [self.world.cables[link.ends()] for link in self.world.topology.links]

    def _set_links(self, rate: float) -> None:
        for number, cable in enumerate(self._cables):
            thin = self.plan.links[number % len(self.plan.links)]
            cable.delay_s, cable.bytes_s = thin.ms / 1e3, rate * thin.mbit_s * 1e6 / 8
            cable.loss, cable.fifo_s = thin.loss / 100, thin.fifo_ms / 1e3

    def _meet(self, label: str) -> None:
        """Let a reader come; what it is owed first arrives as if nothing had been published before."""
        world, network, publisher = self.world, self.world.network, self.flow.publisher
        name = world.members[label].name
        known = publisher.matched.active.get(name)
        if self.plan.is_full:
            self.fill.read_by(label)
            self.fill.stream(int(FILL_S * FILL_HZ), 1 / FILL_HZ, FILL_BYTES)
            network.run(1.0)
        self._set_links(self.plan.rate)
        before = publisher.messages
        self.flow.read_by(label)
        assert network.run(
            JOIN_S, lambda: self.flow.is_read_by(1) and publisher.matched.active.get(name) not in (None, known)
        ), f"{label} is not known"
        # of a best-effort topic each may be lost
        self.flow.stream(1 if self.plan.reliable else TRIES, TRY_S, self.plan.size)
        limit_s = self._limit_s() + (0.0 if self.plan.reliable else TRIES * TRY_S)
        assert network.run(limit_s, lambda: self.flow.has(label, 1)), f"{label} waits for more than {limit_s:.2f} s"
        assert self.flow.got[label][0].sequence > before, "what was published before it came is not for it"
        self._set_links(1.0)

    def _limit_s(self) -> float:
        """Return how long a first message may take: two round trips, its own time twice, a full queue, a repair."""
        cables = self._cables
        trip_s = 2 * sum(each.delay_s + FRAME_BYTES / each.bytes_s for each in cables)
        own_s = (self.plan.size + FRAME_BYTES) / min(each.bytes_s for each in cables)
        repair_s = REPAIR_S if any(each.loss for each in cables) else 0.0
        full_s = FULL_S if self.plan.is_full else 0.0
        return SPARE_S + 2 * (trip_s + own_s) + max(each.fifo_s for each in cables) + repair_s + full_s

    def _meet_next(self, reader: str, other: str) -> str:
        """End the reader while much waits for it; return the one that comes next."""
        plan, network = self.plan, self.world.network
        self.flow.stream(plan.older, 0.0, plan.size)
        network.run(0.2)
        if plan.again == "leave":
            self.world.members[reader].leave()
            network.send_pending(reader)
            network.run(0.2)
        network.stop(reader)
        cut = None if plan.cut < 0 else self._cables[plan.cut % len(self._cables)]
        if cut is not None:
            network.set_link(cut, up=False)
        self.flow.stream(plan.older, 0.0, plan.size)
        # a silent reader blocks the others until it is suspended
        network.run(max(plan.away_s, READER.lease_s + 1.0) if plan.again == "other" else plan.away_s)
        if cut is not None:
            network.set_link(cut, up=True)
            network.run(1.0)
        if plan.again == "restart":
            self.world.restart_member(reader)
        label = reader if plan.again == "restart" else other
        self._meet(label)
        return label

    def _end(self, last: str) -> None:
        """Let all links be well, and check that the last reader gets everything for three leases."""
        for cable in self._cables:
            cable.bytes_s, cable.loss = float("inf"), 0.0
        self.world.network.run(TRIES * TRY_S + 1.0)
        self.world.network.run(DRAIN_S, self.flow.publisher.is_acknowledged)
        self.flow.outlive(last)


THIN: Final = Thin(1.0, 5, 0, 200)
# What waited for the first reader, and was older than it, was sent before what it was owed.
OLDER = Plan("chain", 3, 1, (THIN,), False, True, True, 40, 20_000, 1.0, "", 0.5, -1, 1.0, 1)
# What a killed reader alone lacked was sent before the first message of the one that came in its place.
KILLED = Plan("chain", 3, 1, (THIN,), False, True, False, 8, 20_000, 1.0, "other", 8.0, -1, 1.0, 1)
# A reader that subscribed before its first event stated that it had waited since its machine started.
RESTARTED = Plan("chain", 2, 1, (THIN,), False, True, True, 40, 20_000, 1.0, "restart", 0.5, -1, 1.0, 1)


@pytest.mark.momentary(
    "every trial runs for three leases after its last reader; hypothesis also draws shorter attempts"
)
@draws(1, long=12)
@given(plans())
@example(OLDER)
@example(KILLED)
@example(RESTARTED)
def test_what_was_published_before_a_reader_came_does_not_delay_its_first_message(plan: Plan) -> None:
    with short_leases():
        Trial(plan).run()
