"""Frame size of the narrowest link of the tree, while links and readers come and go."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial

import pytest

from gdp.client.send_options import SendOptions
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.limits import MTU_HOLD_S, MTU_NARROWINGS
from lab.simulation import Simulation
from lab.topology import Topology, chain, ring5
from tests.journeys.flows import LEASE_S, ROBOT, SERVER, Flow, Tap, advertise, flowing, ring
from tests.lanes import nightly

MIDDLE = frozenset(("nuc2", "nuc3"))
DETOUR = frozenset(("nuc5", "nuc1"))
NEWS_S = 0.05  # more than link news needs through the ring, less than any renewal
SMALL, USUAL, JUMBO, LARGEST = 576, 1_500, 9_000, 65_000


def largest(flow: Flow, size: int = 100_000) -> int:
    """Publish a message, check its arrival at every reader, and return its largest frame at the source."""
    tap = Tap(flow.source, flow.source.split("/")[0])
    network, wanted = flow.world.network, {label: len(got) + 1 for label, got in flow.got.items()}
    network.taps.append(tap)
    message = os.urandom(size)
    flow.publish(message)
    assert network.run(5, lambda: all(flow.has(label, count) for label, count in wanted.items()))
    network.taps.remove(tap)
    assert all(got[-1].message == message for got in flow.got.values())
    return max(len(frame) for frame, header in zip(tap.frames, tap.headers, strict=True) if header.kind == Kind.DATA)


def too_big(flow: Flow) -> int:
    """Return how many frames were dropped because a link did not take them."""
    return flow.world.network.drops[DropReason.TOO_BIG]


def wide(topology: Topology, mtu: int = JUMBO, lease_s: float = LEASE_S, **links: int) -> Simulation:
    """Return a network of wide links, except those given as ``a_b=mtu``."""
    narrow = {frozenset(ends.split("_")): size for ends, size in links.items()}
    made = tuple(replace(link, mtu=narrow.get(link.ends(), mtu)) for link in topology.links)
    world = Simulation(topology=replace(topology, links=made), lead_mtu=mtu, lease_s=lease_s)
    assert world.run_until_attached()
    return world


@pytest.mark.parametrize("mtu", [SMALL, USUAL, LARGEST, *nightly(1_280, JUMBO)])
def test_frames_fill_links_of_any_size(mtu: int) -> None:
    flow = flowing(wide(ring5(), mtu))
    assert largest(flow) == mtu
    assert too_big(flow) == 0
    flow.outlive()


@pytest.mark.parametrize("mtu", [SMALL, USUAL, *nightly(1_280, JUMBO)])
def test_one_narrow_link_in_the_middle_decides(mtu: int) -> None:
    flow = flowing(wide(ring5(), LARGEST, nuc2_nuc3=mtu))
    assert largest(flow) == mtu
    assert too_big(flow) == 0
    flow.outlive()


@pytest.mark.parametrize("ends", [MIDDLE, frozenset(("nuc4", "nuc5")), *nightly(frozenset(("nuc1", "nuc2")))])
def test_a_link_that_changes_on_the_way_is_followed_by_the_next_message(ends: frozenset[str]) -> None:
    flow = flowing(ring())
    network, seen = flow.world.network, []
    for mtu in (1_200, 1_400, SMALL, USUAL, JUMBO):
        network.set_mtu(flow.world.cables[ends], mtu)
        network.run(NEWS_S)
        seen.append(largest(flow))
    assert seen == [1_200, 1_400, SMALL, USUAL, USUAL]
    assert too_big(flow) == 0
    flow.outlive()


@pytest.mark.parametrize("label", [ROBOT, SERVER])
def test_the_first_and_the_last_link_count_too(label: str) -> None:
    flow = flowing(wide(ring5()))
    network, seen = flow.world.network, []
    for mtu in (USUAL, JUMBO):
        network.set_mtu(flow.world.leads[label], mtu)
        network.run(NEWS_S)
        seen.append(largest(flow))
    assert seen == [USUAL, JUMBO]
    flow.outlive()


def test_links_that_change_one_after_the_other_are_all_followed() -> None:
    flow = flowing(wide(chain(4), USUAL), source="s1/left", readers=("s4/right",))
    network, seen = flow.world.network, []
    for mtu in (JUMBO, 1_000):
        for sim_link in [*flow.world.cables.values(), *flow.world.leads.values()]:
            network.set_mtu(sim_link, mtu)
        network.run(NEWS_S)
        seen.append(largest(flow))
    assert seen == [JUMBO, 1_000]
    flow.outlive()


def test_a_detour_over_a_narrower_link_is_known_with_its_first_join() -> None:
    flow = flowing(wide(ring5(), nuc1_nuc5=1_200))
    network, sim_link = flow.world.network, flow.world.cables[MIDDLE]
    before = largest(flow)
    network.set_link(sim_link, up=False)
    network.run(2 * NEWS_S)
    over = largest(flow)
    network.set_link(sim_link, up=True)
    network.run(3)
    assert (before, over, largest(flow)) == (JUMBO, 1_200, JUMBO)
    assert {each.hops for each in flow.got[SERVER]} == {5, 2}
    assert too_big(flow) == 0
    flow.outlive()


def test_a_dearer_link_turns_the_tree_and_the_size_with_it() -> None:
    flow = flowing(wide(ring5(), USUAL, nuc1_nuc5=JUMBO))
    network, world = flow.world.network, flow.world
    world.network.set_mtu(world.leads[ROBOT], JUMBO)
    world.network.set_mtu(world.leads[SERVER], JUMBO)
    before = largest(flow)
    network.set_cost(world.cables[MIDDLE], 500)
    network.run(0.5)
    assert (before, largest(flow)) == (USUAL, JUMBO)
    assert flow.hops(SERVER) == [5, 2]
    network.set_cost(world.cables[MIDDLE], 10)
    network.run(0.5)
    assert largest(flow) == USUAL
    assert too_big(flow) == 0
    flow.outlive()


def test_a_reader_behind_a_narrow_link_shrinks_all_frames_while_it_is_there() -> None:
    flow = flowing(wide(ring5(), nuc1_nuc5=JUMBO))
    world, network = flow.world, flow.world.network
    world.lead_mtu = 1_000
    world.add_member("nuc3/narrow", "nuc3")
    assert world.run_until_attached()
    before = largest(flow)
    flow.read_by("nuc3/narrow")
    assert network.run(2, lambda: flow.is_read_by(2))
    neighbouring = largest(flow)
    world.members["nuc3/narrow"].leave()
    network.send_pending("nuc3/narrow")
    del flow.got["nuc3/narrow"]
    network.run(NEWS_S)
    assert (before, neighbouring, largest(flow)) == (JUMBO, 1_000, JUMBO)
    assert too_big(flow) == 0
    flow.outlive()


def test_a_narrow_reader_whose_link_is_lost_no_longer_counts() -> None:
    flow = flowing(wide(ring5()))
    world, network = flow.world, flow.world.network
    world.lead_mtu = 1_000
    world.add_member("nuc3/narrow", "nuc3")
    assert world.run_until_attached()
    flow.read_by("nuc3/narrow")
    assert network.run(2, lambda: flow.is_read_by(2))
    network.set_link(world.leads["nuc3/narrow"], up=False)
    del flow.got["nuc3/narrow"]
    network.run(NEWS_S)
    assert largest(flow) == JUMBO
    flow.outlive()


def test_frames_too_large_for_a_link_that_shrank_under_them_are_counted() -> None:
    flow = flowing(ring(), reliable=False)
    network, sim_link = flow.world.network, flow.world.cables[frozenset(("nuc4", "nuc5"))]
    flow.publish(bytes(20_000))
    network.call(0.001, partial(network.set_mtu, sim_link, 1_000))  # by then they have passed two links of five
    network.run(NEWS_S)
    parts = -(-(20_000 + 64) // (USUAL - 96 - 16))
    assert 0 < too_big(flow) < parts  # the first window, whose last fragment may be a small one
    assert flow.numbers(SERVER) == []
    network.run(1)  # the publisher measures the path again after what was lost
    flow.outlive()


def test_a_stream_goes_on_while_links_shrink_and_grow_between_its_messages() -> None:
    flow = flowing(wide(ring5()))
    network, sim_link = flow.world.network, flow.world.cables[MIDDLE]
    flow.stream(60, 0.1, size=20_000)
    for at_s, mtu in ((1.05, USUAL), (2.05, 700), (3.05, JUMBO), (4.05, 1_280)):
        network.call(at_s, partial(network.set_mtu, sim_link, mtu))
    assert network.run(20, lambda: flow.has(SERVER, 60))
    assert flow.numbers(SERVER) == list(range(60))
    assert [flow.got[SERVER][at].parts for at in (5, 15, 25, 35, 45)] == [3, 15, 35, 3, 18]
    assert too_big(flow) == 0
    flow.outlive()


@pytest.mark.parametrize("where", ["links", pytest.param("leads", marks=pytest.mark.nightly)])
def test_of_news_that_overtake_each_other_the_newest_counts(where: str) -> None:
    flow = flowing(wide(ring5(), lease_s=20.0))  # three leases are over when the last message is sent
    flow.publisher.set_options(SendOptions(fec=False))  # frames that leave space for parity are smaller than the MTU
    world, network, sim_link = flow.world, flow.world.network, flow.world.cables[frozenset(("nuc4", "nuc5"))]
    world.leads[ROBOT].jitter_s = 0.02 if where == "leads" else 0.0
    world.cables[MIDDLE].jitter_s = 0.02 if where == "links" else 0.0
    seen = []
    for last in (JUMBO, 1_280, JUMBO, 800):
        network.run(MTU_HOLD_S * MTU_NARROWINGS)  # the limit of reductions
        for mtu in (1_000, USUAL, SMALL, JUMBO, 700, last):
            network.set_mtu(sim_link, mtu)
            network.run(0.0015)
        network.run(NEWS_S)
        seen.append(largest(flow))
    assert seen == [JUMBO, 1_280, JUMBO, 800]


# a link that shrinks under messages that are already sealed


def test_what_was_sealed_too_large_for_its_link_arrives_all_the_same() -> None:
    flow = flowing(wide(ring5()))
    network, sim_link = flow.world.network, flow.world.cables[MIDDLE]
    flow.stream(20, 0.0005, size=20_000)
    network.call(0.001, partial(network.set_mtu, sim_link, 1_000))
    assert network.run(3, lambda: flow.has(SERVER, 20))  # sooner than a standing reader is evicted
    assert flow.numbers(SERVER) == list(range(20))
    assert too_big(flow) > 0
    flow.outlive()


def test_of_two_readers_neither_gets_a_refragmented_message_twice() -> None:
    world = wide(ring5())
    world.add_member("nuc2/near", "nuc2")
    assert world.run_until_attached()
    flow = flowing(world, readers=(SERVER, "nuc2/near"))
    flow.stream(20, 0.002, size=20_000)
    world.network.call(0.0025, partial(world.network.set_mtu, world.cables[MIDDLE], 1_000))
    assert world.network.run(3, lambda: flow.has(SERVER, 20) and flow.has("nuc2/near", 20))
    world.network.run(3)
    assert flow.numbers(SERVER) == flow.numbers("nuc2/near") == list(range(20))
    assert too_big(flow) > 0
    flow.outlive()


def test_a_late_joiner_behind_a_narrow_link_gets_what_was_kept_for_it() -> None:
    world = wide(ring5())
    world.lead_mtu = 1_000
    world.add_member("nuc3/narrow", "nuc3")
    assert world.run_until_attached()
    flow = advertise(world, depth=3)
    flow.read_by(SERVER)
    assert world.network.run(5, lambda: flow.is_read_by(1))
    flow.stream(5, 0.01, size=20_000)
    assert world.network.run(2, lambda: flow.has(SERVER, 5))
    flow.read_by("nuc3/narrow")
    assert world.network.run(3, lambda: flow.has("nuc3/narrow", 3))
    assert (flow.numbers("nuc3/narrow"), flow.numbers(SERVER)) == ([2, 3, 4], [0, 1, 2, 3, 4])
    flow.outlive()


def test_links_that_shrink_again_and_again_under_a_flow_cost_nothing_but_time() -> None:
    flow = flowing(wide(ring5()))
    network, sim_link = flow.world.network, flow.world.cables[MIDDLE]
    flow.stream(200, 0.005, size=20_000)
    for at, mtu in enumerate((USUAL, 1_000, SMALL, JUMBO, USUAL, JUMBO, JUMBO, 700)):
        network.call(0.1003 + at * 0.1, partial(network.set_mtu, sim_link, mtu))
    assert network.run(10, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    flow.outlive()


def test_a_detour_over_a_narrower_link_loses_nothing_of_a_flow() -> None:
    flow = flowing(wide(ring5(), nuc1_nuc5=1_200))
    network, sim_link = flow.world.network, flow.world.cables[MIDDLE]
    flow.stream(100, 0.005, size=20_000)
    network.call(0.2, partial(network.set_link, sim_link, up=False))
    assert network.run(5, lambda: flow.has(SERVER, 100))
    assert flow.numbers(SERVER) == list(range(100))
    flow.outlive()


def test_reports_of_many_gaps_fit_the_smallest_link() -> None:
    flow = flowing(wide(ring5(), SMALL))
    network, sim_link = flow.world.network, flow.world.cables[MIDDLE]
    sim_link.loss = 0.4
    flow.stream(3, 0.01, size=300_000)
    network.call(0.05, partial(setattr, sim_link, "loss", 0.0))
    assert network.run(2, lambda: flow.has(SERVER, 3))
    assert too_big(flow) == 0
    flow.outlive()
