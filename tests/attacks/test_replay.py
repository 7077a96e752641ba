"""Recorded frames and statements of any age, played back by a stranger at a link: nothing acts twice."""

from __future__ import annotations

import pytest

from gdp.client.writer_proxy import WriterProxyState
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.switch.core import SwitchCore
from gdp.trust.right import Right
from tests.journeys.flows import ROBOT, SERVER, Flow, Tap, flowing, ring
from tests.journeys.services import Party, outlive
from tests.journeys.test_attacks import mac_of, still_flows


def recorded_life(flow: Flow) -> Tap:
    """Return the frames to the reader while the robot sent it five commands."""
    tap = Tap("nuc5", SERVER)
    flow.world.network.taps.append(tap)
    for number in range(5):
        flow.publish(b"DRIVE FORWARD %d" % number)
    assert flow.world.network.run(5, lambda: flow.has(SERVER, 5))
    flow.world.network.run(2)
    flow.world.network.taps.clear()
    return tap


@pytest.mark.parametrize("reliable", [True, False])
def test_a10_commands_of_an_hour_ago_are_not_delivered_to_a_restarted_reader(reliable: bool) -> None:
    world = ring()
    tap = Tap("nuc5", SERVER)
    world.network.taps.append(tap)
    flow = flowing(world, reliable=reliable)
    tap.frames += recorded_life(flow).frames
    world.network.freeze(ROBOT)  # no command of its own comes in between
    reader = world.restart_member(SERVER)
    assert world.network.run(10, lambda: reader.attachment.is_attached)
    reader.subscribe(world.topic(flow.name, reader, [Right.READ]))
    world.network.send_pending(SERVER)
    assert world.network.run(10, lambda: bool(reader.subscriptions.writer_proxies_of(flow.topic.name)))
    for frame in [each for each in tap.frames if each[1] in (Kind.HEARTBEAT, Kind.DATA)] * 2:
        world.network.inject(SERVER, 0, frame, mac_of(world, SERVER))
    world.network.run(1)
    assert reader.poll_messages() == []
    assert [each.state for each in reader.subscriptions.writer_proxies_of(flow.topic.name)] == [WriterProxyState.NEW]
    world.network.thaw(ROBOT)
    flow.got[SERVER] = []
    assert world.network.run(
        20, lambda: reader.subscriptions.writer_proxies_of(flow.topic.name)[0].state is WriterProxyState.LIVE
    )
    still_flows(flow)
    flow.outlive()


def test_a11_a_request_of_ten_minutes_ago_is_not_delivered_to_a_restarted_server() -> None:
    world = ring()
    tap = Tap("nuc5", SERVER)
    world.network.taps.append(tap)
    server, client = Party(world, SERVER, Right.SERVE), Party(world, ROBOT, Right.CALL)
    assert world.network.run(10, lambda: client.member.services.peers(client.service) != [])
    client.publish(b"open the gripper")
    assert world.network.run(10, lambda: server.bodies() == [b"open the gripper"])
    world.network.taps.clear()
    world.network.freeze(ROBOT)
    restarted = world.restart_member(SERVER)
    assert world.network.run(10, lambda: restarted.attachment.is_attached)
    server.got.clear()
    server.begin()
    assert world.network.run(10, lambda: restarted.subscriptions.writer_proxies_of(server.service) != [])
    for frame in [each for each in tap.frames if each[1] in (Kind.HEARTBEAT, Kind.DATA)] * 2:
        world.network.inject(SERVER, 0, frame, mac_of(world, SERVER))
    world.network.run(1)
    assert server.bodies() == []
    world.network.thaw(ROBOT)
    outlive(world, client, server)


def test_a09_an_old_gone_of_a_publisher_that_came_back_silences_no_topic() -> None:
    world = ring()
    tap = Tap("nuc4", "nuc5")
    world.network.taps.append(tap)
    flow = flowing(world)
    world.members[ROBOT].leave()
    world.network.send_pending(ROBOT)
    world.network.run(3)
    gone = [frame for frame in tap.frames if frame[1] == Kind.RIB_ANSWER]
    assert gone
    member = world.restart_member(ROBOT)
    flow = Flow(world, flow.name, ROBOT, flow.topic, member.advertise(flow.topic, b"", reliable=True), flow.got)
    world.network.send_pending(ROBOT)
    assert world.network.run(20, lambda: flow.is_read_by(1))
    flow.collect()
    before = len(flow.got[SERVER])
    for number in range(50):
        flow.publish(b"message %d" % number)
        for frame in gone:
            world.network.inject("nuc5", 0, frame, mac_of(world, "nuc5"))
        world.network.run(0.05)
    assert world.network.run(5, lambda: flow.has(SERVER, before + 50))
    assert world.switches["nuc5"].drops()[DropReason.REPLAYED] >= 50
    assert sum(world.members[SERVER].subscriptions.lost().values()) == 0
    flow.outlive()


@pytest.mark.parametrize("right", [Right.PUBLISH, Right.READ])
def test_a39_a_recorded_advertisement_of_what_was_withdrawn_is_not_taken_again(right: Right) -> None:
    world = ring()
    flow = flowing(world)
    member = world.members[ROBOT]
    topic = world.topic("/withdrawn", member, [right])
    tap = Tap(ROBOT, "nuc1")
    world.network.taps.append(tap)
    if right is Right.PUBLISH:
        member.advertise(topic, b"described", reliable=True)
    else:
        member.subscribe(topic)
    world.network.send_pending(ROBOT)
    world.network.run(1)
    nuc1 = world.switches["nuc1"]
    advertisements = [
        frame for header, frame in zip(tap.headers, tap.frames, strict=True) if header.kind == Kind.ADVERTISE
    ]
    assert _is_pending_advertisement(nuc1, topic.name, member.name)
    if right is Right.PUBLISH:
        member.withdraw(topic.name)
    else:
        member.unsubscribe(topic.name)
    world.network.send_pending(ROBOT)
    world.network.run(1)
    assert not _is_pending_advertisement(nuc1, topic.name, member.name)
    for frame in advertisements:
        world.network.inject("nuc1", 2, frame, mac_of(world, "nuc1", 2))
    assert not _is_pending_advertisement(nuc1, topic.name, member.name)
    assert nuc1.drops()[DropReason.REPLAYED] > 0
    still_flows(flow)


def test_a39_a_recorded_advertisement_of_an_earlier_life_of_an_attached_node_is_not_taken() -> None:
    world = ring()
    tap = Tap(ROBOT, "nuc1")
    world.network.taps.append(tap)
    flow = flowing(world)
    advertisements = [
        frame for header, frame in zip(tap.headers, tap.frames, strict=True) if header.kind == Kind.ADVERTISE
    ]
    nuc1 = world.restart_switch("nuc1")
    member = world.restart_member(ROBOT)
    assert world.network.run(10, lambda: member.attachment.is_attached)
    for frame in advertisements:
        world.network.inject("nuc1", 2, frame, mac_of(world, "nuc1", 2))
    assert not _is_pending_advertisement(nuc1, flow.topic.name, member.name)
    assert nuc1.drops()[DropReason.REPLAYED] > 0


def _is_pending_advertisement(switch: SwitchCore, name: Name, node: Name) -> bool:
    return switch.attached.get(name, node) is not None or bool(switch.state.readers.of(name))
