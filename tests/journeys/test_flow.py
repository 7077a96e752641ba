"""Messages across the ring of five: through three transit switches, past failures, to all permitted readers."""

from __future__ import annotations

import pytest

from gdp.frame.codec import Kind
from gdp.intervals import JOIN, NEIGHBOUR
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import ring5
from tests.journeys.flows import LEASE_S, LEASES, ROBOT, SERVER, Tap, advertise, flowing, outlive_together, ring, row
from tests.lanes import nightly

LONG = frozenset(("nuc2", "nuc3"))


def test_a_message_takes_the_cheap_way_over_five_switches() -> None:
    flow = flowing(ring())
    flow.publish(b"hello")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 1))
    assert [(each.message, each.hops) for each in flow.got[SERVER]] == [(b"hello", 5)]
    flow.outlive()


def test_a_cut_in_mid_flow_turns_the_traffic_and_loses_nothing() -> None:
    flow = flowing(ring())
    network = flow.world.network
    flow.stream(100, 0.02)
    network.call(1.0, lambda: network.set_link(flow.world.cables[LONG], up=False))
    assert network.run(10, lambda: flow.has(SERVER, 100))
    assert flow.numbers(SERVER) == list(range(100))
    hops = flow.hops(SERVER)
    assert (hops[0], hops[-1]) == (5, 2)
    flow.outlive()


def test_a_link_that_dies_without_a_word_is_noticed_by_its_silence() -> None:
    flow = flowing(ring(keepalive_ms=None))
    flow.stream(100, 0.02)
    flow.world.network.call(1.0, lambda: setattr(flow.world.cables[LONG], "loss", 1.0))
    assert flow.world.network.run(10, lambda: flow.has(SERVER, 100))
    assert (flow.numbers(SERVER), flow.hops(SERVER)[-1]) == (list(range(100)), 2)
    flow.outlive()


def test_a_link_that_comes_back_is_used_again() -> None:
    flow = flowing(ring())
    network = flow.world.network
    network.set_link(flow.world.cables[LONG], up=False)
    network.run(2)
    network.set_link(flow.world.cables[LONG], up=True)
    network.run(3)
    flow.publish(b"back")
    assert network.run(1, lambda: flow.has(SERVER, 1))
    assert flow.hops(SERVER) == [5]
    flow.outlive()


@pytest.mark.parametrize("name", ["nuc1", "nuc3", *nightly("nuc2", "nuc4", "nuc5")])
def test_a_restarted_switch_is_accepted_again_and_nothing_is_lost(name: str) -> None:
    flow = flowing(ring())
    network = flow.world.network
    flow.stream(200, 0.02, size=100)
    network.call(1.0, lambda: network.stop(name))
    network.call(2.5, lambda: (flow.world.restart_switch(name), None)[1])
    assert network.run(30, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    flow.outlive()


def test_a_switch_that_restarts_in_an_instant_is_noticed_by_its_session() -> None:
    flow = flowing(ring())
    flow.stream(100, 0.02)
    flow.world.network.call(1.0, lambda: (flow.world.restart_switch("nuc3"), None)[1])
    assert flow.world.network.run(10, lambda: flow.has(SERVER, 100))
    assert flow.numbers(SERVER) == list(range(100))
    flow.outlive()


@pytest.mark.parametrize("label", ["backbone", *nightly("school", "cloud")])
def test_a_restarted_rib_disturbs_no_flow_and_is_refilled(label: str) -> None:
    flow = flowing(ring())
    world = flow.world
    names = world.ribs[label].rib.names
    flow.stream(230, 0.1, size=100)  # longer than three leases of joins
    world.network.call(1.0, lambda: (world.restart_rib(label), None)[1])
    world.network.run(23.5)
    assert flow.numbers(SERVER) == list(range(230))
    assert world.ribs[label].rib.names == names > 0
    delays = {each.hops for each in flow.got[SERVER]}
    assert delays == {5}
    flow.outlive()


def test_a_late_joiner_of_a_latched_topic_gets_the_last_messages() -> None:
    flow = advertise(row(), depth=3)
    for number in range(5):
        flow.publish(b"%d" % number)
    flow.world.network.run(5)
    flow.read_by(SERVER)
    assert flow.world.network.run(3, lambda: flow.has(SERVER, 3))
    assert [each.message for each in flow.got[SERVER]] == [b"2", b"3", b"4"]
    flow.outlive()


def test_what_is_older_than_a_reader_does_not_delay_its_first_message() -> None:
    flow = advertise(row())
    network = flow.world.network
    flow.world.leads[ROBOT].bytes_s = 50_000
    flow.publisher.await_readers(network.now.mono_s + 6)
    for _ in range(8):
        flow.publish(bytes(20_000))  # all of them take three seconds
    network.run(1)
    flow.read_by(SERVER)
    assert network.run(2, lambda: flow.is_read_by(1))
    flow.publish(b"now")
    assert network.run(0.5, lambda: flow.has(SERVER, 1))
    assert [each.message for each in flow.got[SERVER]] == [b"now"]
    flow.outlive()


def test_two_publishers_of_one_topic_both_reach_its_reader() -> None:
    world = row()
    world.add_member("nuc2/second", "nuc2")
    assert world.run_until_attached()
    first = flowing(world, readers=(SERVER,))
    second = advertise(world, source="nuc2/second")
    second.got = first.got
    assert world.network.run(3, lambda: second.is_read_by(1))
    first.publish(b"from the robot")
    second.publish(b"from the second")
    assert world.network.run(2, lambda: first.has(SERVER, 2))
    assert {each.message for each in first.got[SERVER]} == {b"from the robot", b"from the second"}
    world.network.run(LEASES * world.lease_s)
    first.publish(b"again")
    second.publish(b"again")
    assert world.network.run(1, lambda: second.has(SERVER, 4))


def test_a_publisher_that_comes_after_its_reader_is_found() -> None:
    world = row()
    reader = world.members[SERVER]
    reader.subscribe(world.topic("/late", reader, [Right.READ]))
    world.network.run(10)
    flow = advertise(world, "/late")
    assert world.network.run(3, lambda: flow.is_read_by(1))
    flow.outlive()


def test_two_readers_cost_a_shared_link_one_copy() -> None:
    world = ring()
    world.add_member("nuc4/second", "nuc4")
    assert world.run_until_attached()
    flow = flowing(world, readers=(SERVER, "nuc4/second"))
    tap = Tap("nuc2", "nuc3")
    world.network.taps.append(tap)
    for _ in range(10):
        flow.publish(b"x" * 100)
    assert world.network.run(2, lambda: flow.has(SERVER, 10) and flow.has("nuc4/second", 10))
    assert tap.count(Kind.DATA) == 10
    flow.outlive()


def test_a_tree_without_readers_is_taken_down() -> None:
    flow = flowing(row())
    world = flow.world
    assert any(switch.multicast.trees.all() for switch in world.switches.values())
    world.members[SERVER].leave()
    world.network.send_pending(SERVER)
    world.network.run(JOIN.lease_s + 1)
    assert not any(switch.multicast.trees.all() for switch in world.switches.values())
    flow.outlive(negative=True)


def test_loss_on_every_link_costs_no_message() -> None:
    flow = flowing(ring())
    for sim_link in flow.world.cables.values():
        sim_link.loss = 0.02
    flow.stream(200, 0.01)
    assert flow.world.network.run(30, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    assert flow.world.network.lost > 0
    flow.outlive()


def test_frames_that_overtake_each_other_arrive_in_order() -> None:
    flow = flowing(ring())
    for sim_link in flow.world.cables.values():
        sim_link.jitter_s = 0.005
    flow.stream(200, 0.005, size=5_000)
    assert flow.world.network.run(30, lambda: flow.has(SERVER, 200))
    assert flow.numbers(SERVER) == list(range(200))
    flow.outlive()


def test_the_network_settles_with_loss_from_the_beginning() -> None:
    world = Simulation(topology=ring5(), lease_s=LEASE_S)
    for sim_link in world.cables.values():
        sim_link.loss = 0.1
    assert world.run_until_attached(30)
    world.network.run(LEASES * world.lease_s)
    assert world.run_until_attached(1)
    world.network.run(LEASES * world.lease_s)


@pytest.mark.momentary("hellos have no lease of a name")
def test_a_dead_neighbour_is_let_go_after_its_silence() -> None:
    world = ring(keepalive_ms=None)
    world.network.stop("nuc3")
    world.network.run(NEIGHBOUR.lease_s + 0.5)
    assert all(
        n.name != world.identities["nuc3"].name for n in world.switches["nuc2"].hello_protocol.neighbours.all_up()
    )


def test_best_effort_over_loss_goes_on_without_what_is_lost() -> None:
    flow = flowing(row(), reliable=False)
    for sim_link in flow.world.cables.values():
        sim_link.loss = 0.1
    flow.stream(200, 0.01, size=100)
    flow.world.network.run(5)
    numbers = flow.numbers(SERVER)
    assert 100 < len(numbers) < 200
    assert numbers == sorted(set(numbers))
    for sim_link in flow.world.cables.values():
        sim_link.loss = 0.0
    flow.outlive()


@pytest.mark.parametrize("seed", [1, *nightly(3)])
def test_names_of_live_nodes_do_not_lapse_though_every_link_loses_statements(seed: int) -> None:
    """A statement has some five frames, so 8 % of lost frames are a third of the statements on each link."""
    flow = flowing(ring(seed, lease_s=6.0), reliable=False)
    world = flow.world
    knowing = [host.rib for host in world.ribs.values() if host.rib.state.store.routes(flow.topic.name)]
    assert len(knowing) == 3
    for sim_link in world.cables.values():
        sim_link.loss = 0.08
    for _ in range(120):
        world.network.run(0.25)
        assert all(rib.state.store.routes(flow.topic.name) for rib in knowing), world.network.now


def test_both_directions_flow_at_once() -> None:
    world = row()
    there = flowing(world, "/there")
    back = flowing(world, "/back", SERVER, (ROBOT,))
    there.stream(50, 0.01)
    back.stream(50, 0.01)
    assert world.network.run(5, lambda: there.has(SERVER, 50) and back.has(ROBOT, 50))
    outlive_together(there, back)
