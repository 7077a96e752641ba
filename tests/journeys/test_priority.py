"""Urgent messages go first, and a slow reader delays only itself."""

from __future__ import annotations

import pytest

from gdp.client.send_scheduler import BYTES_WITH_URGENT
from gdp.frame.codec import Flag, Kind, decode
from tests.journeys.flows import ROBOT, SERVER, advertise, flowing, row

IMAGE = bytes(921_600)

pytestmark = pytest.mark.momentary("the order of frames within one turn of the loop")


def test_an_urgent_message_leaves_before_what_waits_of_others() -> None:
    world = row()
    images = flowing(world, "/image")
    urgent = advertise(world, "/cmd_vel", urgent=True)
    urgent.read_by(SERVER)
    assert world.network.run(5, lambda: urgent.is_read_by(1))
    member, now_s = world.members[ROBOT], world.network.now.mono_s
    for _ in range(3):
        images.publisher.publish(IMAGE)
    member.flush(now_s)
    sent_before = [frame for each in member.frames_to_send(world.network.now.mono_s) for frame in each.frames]
    urgent.publisher.publish(b"stop")
    headers = [decode(frame) for each in member.frames_to_send(world.network.now.mono_s) for frame in each.frames]
    assert len(sent_before) * 1_500 < len(IMAGE)  # most of the images still wait
    assert next(header.destination for header in headers if header.kind == Kind.DATA) == urgent.topic.name
    assert headers[0].flags & Flag.URGENT


def test_topics_that_are_not_urgent_take_turns() -> None:
    world = row()
    flows = [flowing(world, name) for name in ("/left", "/right")]
    member, now_s = world.members[ROBOT], world.network.now.mono_s
    for flow in flows:
        flow.publisher.publish(IMAGE)
    member.flush(now_s)
    headers = [decode(frame) for each in member.frames_to_send(now_s) for frame in each.frames]
    first = [header.destination for header in headers if header.kind == Kind.DATA][:4]
    assert set(first) == {flow.topic.name for flow in flows}


def test_an_urgent_message_waits_for_no_more_than_a_chunk_of_a_best_effort_image() -> None:
    world = row()
    images = flowing(world, "/image", reliable=False)
    urgent = advertise(world, "/cmd_vel", urgent=True)
    urgent.read_by(SERVER)
    assert world.network.run(5, lambda: urgent.is_read_by(1))
    member = world.members[ROBOT]
    images.publisher.publish(IMAGE)
    member.flush(world.network.now.mono_s)
    assert (
        sum(len(frame) for each in member.frames_to_send(world.network.now.mono_s) for frame in each.frames)
        <= BYTES_WITH_URGENT
    )
    urgent.publisher.publish(b"stop")
    headers = [decode(frame) for each in member.frames_to_send(world.network.now.mono_s) for frame in each.frames]
    assert {header.destination for header in headers} == {urgent.topic.name}
