"""Silence of a flow when a border on its path dies, its switch moves or a reader thaws, whatever came before."""

from __future__ import annotations

import random
from collections import defaultdict
from functools import partial
from itertools import pairwise

import pytest

from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import Flow, flowing

PERIOD_S = 0.01
AFTER_S = 2.0  # for which a flow continues after what befalls it
BORDER_S = 0.35  # keepalives missing for up to 0.2 s show the death; what follows takes the SPF delay and the way
MOVE_S = 0.15

momentary = pytest.mark.momentary("the leases of a flow say nothing of the time until it takes another path")


def network(links: list[Link], domains: dict[str, str], ribs: str, source: str, reader: str, seed: int) -> Simulation:
    """Return a settled network; ``domains`` are the numbers of each one's switches, all under the first one."""
    labels = list(domains)
    plans = [
        DomainPlan(label, tuple(label + n for n in domains[label]), upper=labels[0] if at else None)
        for at, label in enumerate(labels)
    ]
    nodes = [Attachment(rib, "rib", "rib") for rib in ribs.split()]
    nodes += [Attachment(source, "proxy", "P"), Attachment(reader, "proxy", "R")]
    topology = Topology(tuple(links), tuple(plans), tuple(nodes))
    world = Simulation(topology=topology, seed=seed, keepalive_ms=None)
    assert world.run_until_attached()
    return world


def silence_s(flow: Flow, event_s: float) -> float:
    """Publish until some time after an event; return the longest time between messages from it on, none being lost."""
    network, member = flow.world.network, flow.world.members[next(iter(flow.got))]
    count = round((event_s + AFTER_S) / PERIOD_S)
    flow.stream(count, PERIOD_S, size=100)
    since_s = network.now.mono_s + event_s
    came_s: list[float] = []

    def look() -> bool:
        came_s.extend([network.now.mono_s] * len(member.poll_messages()))
        return False

    network.run(event_s + AFTER_S + 1.0, look)
    assert len(came_s) == count
    return max(later - earlier for earlier, later in pairwise(came_s) if later > since_s)


@momentary
@pytest.mark.parametrize("seed", [4, 30, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(40, 60))])
def test_a_dead_border_silences_a_flow_for_a_third_of_a_second_whatever_changed_before(seed: int) -> None:
    chance = random.Random(seed)
    used = chance.choice("23")
    links = [Link(f"{side}1", f"{side}{n}", cost=10 if n == used else 14) for side in "ab" for n in "23"]
    links += [Link("a2", "b2"), Link("a3", "b3"), Link("a1", "a4"), Link("b1", "b4")]  # no path needs a4 or b4
    world = network(links, {"a": "1234", "b": "1234"}, "a1 b1", "a1", "b1", seed)
    flow, event_s = flowing(world, source="a1/P", readers=("b1/R",)), chance.uniform(0.2, 4.0)
    for side in chance.sample("ab", chance.randrange(3)):
        spur = world.cables[frozenset((f"{side}1", f"{side}4"))]
        for at in range(chance.randrange(1, 4)):
            world.network.call(event_s * chance.random(), partial(world.network.set_link, spur, up=bool(at % 2)))
    world.network.call(event_s, partial(world.network.stop, chance.choice("ab") + used))
    assert silence_s(flow, event_s) <= BORDER_S


@momentary
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(2, 12))])
def test_a_switch_that_moves_to_another_domain_silences_a_flow_for_a_moment_whatever_changed_before(seed: int) -> None:
    chance = random.Random(seed)
    homes = [Link("a2", "a1"), Link("a2", "b1")]
    links = [*homes, Link("a1", "t1"), Link("b1", "t1"), Link("c1", "t1")]
    world = network(links, {"t": "1", "a": "12", "b": "1", "c": "1"}, "t1 a1 b1 c1", "a2", "c1", seed)
    old, new = (world.cables[each.ends()] for each in homes)
    world.network.set_link(new, up=False)
    flow, event_s = flowing(world, source="a2/P", readers=("c1/R",)), chance.uniform(0.3, 3.0)
    world.network.call(event_s, partial(world.network.set_link, old, up=False))
    world.network.call(event_s + 0.01, partial(world.network.set_link, new, up=True))
    assert silence_s(flow, event_s) <= MOVE_S


@momentary
@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(4, 16))])
def test_a_reader_that_was_cut_off_silences_no_other_when_it_is_back_and_is_served_soon(seed: int) -> None:
    chance = random.Random(seed)
    links = [Link("a1", "a2"), Link("a1", "a3")]
    world = network(links, {"a": "123"}, "a1", "a1", "a3", seed)
    world.add_member("a2/F", "a2", "a")
    assert world.run_until_attached()
    flow, lone = flowing(world, source="a1/P", readers=("a3/R", "a2/F")), flowing(world, "/lone", "a1/P", ("a2/F",))
    freezes_s, lasts_s, every_s = chance.uniform(1.0, 1.5), chance.uniform(0.5, 4.0), 0.2
    count = round((freezes_s + lasts_s + 5.0) / every_s)
    for each in (flow, lone):
        each.stream(count, every_s, size=3_000)
    begun_s, came_s = world.network.now.mono_s, defaultdict[str, list[float]](list)
    world.network.call(freezes_s, partial(world.network.freeze, "a2"))
    world.network.call(freezes_s + lasts_s, partial(world.network.thaw, "a2"))

    def look() -> bool:
        for label, name in (("a3/R", flow.topic.name), ("a2/F", lone.topic.name)):
            got = [each for each in world.members[label].poll_messages() if each.topic == name]
            came_s[label] += [world.network.now.mono_s - begun_s] * len(got)
        return False

    world.network.run(freezes_s + lasts_s + 6.0, look)
    assert len(came_s["a3/R"]) == len(came_s["a2/F"]) == count
    assert max(later - earlier for earlier, later in pairwise(came_s["a3/R"])) < 1.5 * every_s
    thawed_s = freezes_s + lasts_s
    assert min(each for each in came_s["a2/F"] if each > thawed_s + every_s) < thawed_s + 1.0
