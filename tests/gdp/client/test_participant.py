"""Participant that adds names, removes them and adds them again: numbers continue, and no state stays behind."""

from __future__ import annotations

import gc

import pytest

from gdp.client.participant import Participant
from gdp.client.send_options import SendOptions
from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Flag, Header, Kind, encode
from gdp.sansio import ReceivedFrame
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, Flow, Tap, advertise, flowing, row

ROUNDS = 600


def again(flow: Flow, *, reliable: bool = True, depth: int = 0, description: bytes = b"described again") -> None:
    """Advertise a withdrawn topic again."""
    flow.publisher = flow.member.advertise(flow.topic, description, reliable=reliable, depth=depth)
    flow.world.network.send_pending(flow.source)


def test_a_topic_advertised_again_goes_on_above_all_numbers() -> None:
    flow = flowing(row())
    flow.publish(b"first")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 1))
    flow.member.withdraw(flow.topic.name)
    flow.world.network.send_pending(ROBOT)
    again(flow)
    assert flow.world.network.run(5, lambda: flow.is_read_by(1))
    flow.publish(b"second")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 2))
    assert [(each.number, each.message) for each in flow.got[SERVER]] == [(1, b"first"), (2, b"second")]


def test_a_topic_may_come_back_as_something_else() -> None:
    flow = flowing(row())
    flow.publish(b"reliable")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 1))
    flow.member.withdraw(flow.topic.name)
    flow.world.network.send_pending(ROBOT)
    assert flow.world.network.run(
        1, lambda: not flow.world.members[SERVER].subscriptions.writer_proxies_of(flow.topic.name)
    )
    again(flow, reliable=False, depth=2)
    for number in range(4):
        flow.publish(b"%d" % number)
    assert flow.world.network.run(5, lambda: flow.has(SERVER, 3))
    assert [each.message for each in flow.got[SERVER]] == [b"reliable", b"2", b"3"]
    (writer_proxy,) = flow.world.members[SERVER].subscriptions.writer_proxies_of(flow.topic.name)
    assert writer_proxy.description == b"described again"


def test_messages_of_a_withdrawn_name_reach_no_reader() -> None:
    flow = flowing(row())
    flow.member.withdraw(flow.topic.name)
    flow.member.withdraw(flow.topic.name)
    assert flow.publisher.publish(b"too late") is None
    assert flow.member.drops()[DropReason.NO_READER] == 0
    assert flow.publisher.drops[DropReason.NO_READER] == 1
    assert list(flow.member.publications) == []


def test_withdrawing_does_not_end_reading_the_same_name() -> None:
    world = row()
    flow = flowing(world)
    reader = world.members[SERVER]
    both = world.topic(flow.name, reader, [Right.PUBLISH, Right.READ])
    reader.advertise(both, b"", reliable=True)
    world.network.send_pending(SERVER)
    world.network.run(1)
    reader.withdraw(both.name)
    world.network.send_pending(SERVER)
    world.network.run(1)
    tap = Tap("nuc5", SERVER)
    world.network.taps.append(tap)
    flow.publish(b"still here")
    assert world.network.run(1, lambda: flow.has(SERVER, 1))
    assert tap.count(Kind.DATA) == 1


def test_a_topic_is_read_again_from_what_is_new_then_and_replays_are_refused() -> None:
    flow = flowing(row())
    network, reader = flow.world.network, flow.world.members[SERVER]
    tap = Tap("nuc5", SERVER)
    network.taps.append(tap)
    flow.publish(b"heard")
    assert network.run(1, lambda: flow.has(SERVER, 1))
    network.run(1)
    reader.unsubscribe(flow.topic.name)
    network.send_pending(SERVER)
    assert network.run(1, lambda: flow.publisher.readers == 0)
    network.taps.clear()
    flow.publish(b"unheard")
    reader.subscribe(flow.world.topic(flow.name, reader, [Right.READ]))
    network.send_pending(SERVER)
    assert network.run(1, lambda: bool(reader.subscriptions.writer_proxies_of(flow.topic.name)))
    switch = reader.attachment.switch
    assert switch is not None
    reader.receive([ReceivedFrame(switch.port, switch.mac, frame) for frame in tap.frames], network.now)
    assert network.run(5, lambda: flow.is_read_by(1))
    flow.publish(b"heard again")
    assert network.run(1, lambda: flow.has(SERVER, 2))
    assert [each.message for each in flow.got[SERVER]] == [b"heard", b"heard again"]


def test_the_last_messages_of_a_latched_topic_come_again_to_who_reads_it_again() -> None:
    flow = advertise(row(), depth=1)
    flow.read_by(SERVER)
    assert flow.world.network.run(5, lambda: flow.is_read_by(1))
    flow.publish(b"the map")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 1))
    got, reader = flow.got[SERVER], flow.world.members[SERVER]
    reader.unsubscribe(flow.topic.name)
    flow.world.network.send_pending(SERVER)
    assert flow.world.network.run(1, lambda: flow.publisher.readers == 0)
    flow.read_by(SERVER)
    assert flow.world.network.run(5, lambda: flow.has(SERVER, 1))
    assert [each.message for each in got + flow.got[SERVER]] == [b"the map"] * 2


def test_who_reads_before_its_first_event_has_waited_since_then() -> None:
    world = row()
    member = world.restart_member(SERVER)
    topic = world.topic("/chatter", member, [Right.READ])
    member.subscribe(topic)
    subscription = member.subscriptions.get(topic.name)
    assert subscription is not None
    assert subscription.since_s == world.network.now.mono_s


def test_a_topic_is_read_once_at_a_time() -> None:
    flow = flowing(row())
    reader = flow.world.members[SERVER]
    with pytest.raises(LocalError, match="in use"):
        reader.subscribe(flow.world.topic(flow.name, reader, [Right.READ]))


def test_a_new_description_reaches_who_reads_already_though_frames_are_lost() -> None:
    flow = flowing(row())
    network, reader = flow.world.network, flow.world.members[SERVER]
    (writer_proxy,) = reader.subscriptions.writer_proxies_of(flow.topic.name)
    assert network.run(1, lambda: writer_proxy.description == b"described")
    flow.world.leads[SERVER].loss = 1.0
    flow.publisher.describe(b"another")
    network.send_pending(ROBOT)
    network.run(0.5)
    assert writer_proxy.description == b"described"
    flow.world.leads[SERVER].loss = 0.0
    assert network.run(5, lambda: writer_proxy.description == b"another")
    flow.publish(b"as described")
    assert network.run(1, lambda: flow.has(SERVER, 1))


@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 1), (0, 2), (2, 0)])
@pytest.mark.parametrize("reliable", [True, False])
def test_late_joiners_get_as_many_messages_as_the_depth_is_now(before: int, after: int, *, reliable: bool) -> None:
    world = row()
    world.add_member("nuc2/other", "nuc2")
    assert world.run_until_attached()
    flow = advertise(world, reliable=reliable, depth=before)
    flow.read_by(SERVER)
    assert world.network.run(5, lambda: flow.is_read_by(1))
    flow.publish(b"0")
    flow.publisher.set_depth(after)
    for number in range(1, 7):
        flow.publish(b"%d" % number)
        world.network.run(0.1)
    assert flow.has(SERVER, 7)
    flow.read_by("nuc2/other")
    assert world.network.run(5, lambda: flow.is_read_by(2))
    world.network.run(1)
    flow.publish(b"last")
    assert world.network.run(1, lambda: flow.has("nuc2/other", after + 1))
    late = [each.message for each in flow.got["nuc2/other"]]
    assert late == [b"%d" % number for number in range(7 - after, 7)] + [b"last"]
    assert world.network.run(1, lambda: flow.has(SERVER, 8))


def sizes(world: Simulation) -> list[int]:
    """Return the size of all nodes' tables, except names of the simulation itself."""
    switches = [
        (len(switch.attached), len(switch.resolver.cache), len(switch.multicast.trees), len(switch.table.entries))
        for switch in world.switches.values()
    ]
    ribs = [(host.rib.names, len(host.rib.state.outbox.watches)) for host in world.ribs.values()]
    return [each for row in [*switches, *ribs] for each in row]


def test_send_options_reach_the_publisher_of_a_topic() -> None:
    world = row()
    member = world.members[ROBOT]
    options = SendOptions(deadline_s=0.2, weight=3, max_bits_s=1e6, repairs=False)
    topic = world.topic("/camera", member, [Right.PUBLISH])
    assert member.advertise(topic, b"", reliable=False, options=options).options == options


@pytest.mark.parametrize("right", [Right.SERVE, Right.CALL])
def test_send_options_reach_the_stream_of_a_service(right: Right) -> None:
    world = row()
    member = world.members[ROBOT]
    options = SendOptions(weight=3, max_bits_s=1e6)
    topic = world.topic("/plan", member, [right], kind="service")
    join = member.serve if right is Right.SERVE else member.call
    assert join(topic, b"", options=options).options == options


def count_objects() -> int:
    """Return the number of objects that could hold others."""
    gc.collect()
    return len(gc.get_objects())


def rounds(world: Simulation, member: Participant, times: int) -> None:
    """Add a topic and a service and remove them again, in both directions."""
    publishes = world.topic("/appears", member, [Right.PUBLISH])
    reads = world.topic("/chatter", member, [Right.READ])
    serves = world.topic("/serves", member, [Right.SERVE], kind="service")
    for number in range(times):
        member.advertise(publishes, b"", reliable=True, depth=number % 3)
        member.subscribe(reads)
        member.serve(serves, b"")
        if number % 50 == 0:
            world.network.send_pending(ROBOT)
            world.network.run(0.1)
        member.withdraw(publishes.name)
        member.unsubscribe(reads.name)
        member.withdraw(serves.name)
        if number % 50 == 0:
            world.network.send_pending(ROBOT)
            world.network.run(0.05)
    world.network.send_pending(ROBOT)
    world.network.run(40)


def test_hundreds_of_appearances_and_disappearances_leave_nothing_behind() -> None:
    world = row()
    flow = advertise(world, source=SERVER)
    member = world.members[ROBOT]
    rounds(world, member, ROUNDS // 20)
    tables, objects = sizes(world), count_objects()
    rounds(world, member, ROUNDS)
    assert max(now - before for now, before in zip(sizes(world), tables, strict=True)) <= 2
    assert count_objects() - objects < ROUNDS // 2  # a RIB keeps each validity that it saw for ten minutes
    assert flow.publisher.readers == 0


def test_each_frame_of_an_unknown_kind_is_dropped_and_counted_once() -> None:
    world = row()
    member = world.members[ROBOT]
    switch = member.attachment.switch
    assert switch is not None
    frame = encode(Header(0x7F, Flag.NONE, 64, 1, 0, 1, 0, 1, 1, switch.name, member.name))
    member.receive(2 * [ReceivedFrame(switch.port, switch.mac, frame)], world.network.now)
    assert member.drops()[DropReason.UNKNOWN_KIND] == 2
