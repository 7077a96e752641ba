"""Message converter on every message of the shared recordings."""

from __future__ import annotations

import json

import pytest
from rosbags.typesys import Stores, get_typestore

from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel
from proxy.serial.converter import MessageConverter, translated_channel
from proxy.serial.serializer import Serializer, canonical
from tests.proxy.recordings.samples import READABLE, recording


@pytest.mark.parametrize("name", READABLE)
def test_every_message_of_a_recording_crosses_and_comes_back_identical_but_for_seq(name: str) -> None:
    with BagReader(recording(name)) as bag:
        sides = [(channel, translated_channel(channel, 1 if channel.ros == 2 else 2)) for channel in bag.channels]
        ways = [(MessageConverter(here, there), MessageConverter(there, here)) for here, there in sides]
        for message in bag.messages():
            onward, backward = ways[message.channel]
            here, there = sides[message.channel]
            crossed = onward.convert(message.raw)
            assert canonical(there, crossed) == crossed
            assert backward.convert(crossed) == _without_seq(here, message.raw)


@pytest.mark.parametrize("name", [name for name in READABLE if name.endswith(".bag")])
def test_rosbags_converts_the_types_it_knows_to_the_same_bytes(name: str) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with BagReader(recording(name)) as bag:
        ways = [MessageConverter(channel, translated_channel(channel, 2)) for channel in bag.channels]
        compared = 0
        for message in bag.messages():
            channel = bag.channels[message.channel]
            if channel.type_name not in store.fielddefs:
                continue
            crossed = ways[message.channel].convert(message.raw)
            assert crossed == bytes(store.ros1_to_cdr(message.raw, channel.type_name))
            compared += 1
    assert compared or name == "event_camera.bag"


def test_rosbags_writes_ros_1_for_the_ros_2_recording_with_the_same_bytes() -> None:
    """It knows one list of types at a time and no ``seq``, so only types without a header can be compared."""
    store = get_typestore(Stores.ROS2_JAZZY)
    compared = 0
    with BagReader(recording("ninety_four_types.mcap")) as bag:
        ways = [MessageConverter(channel, translated_channel(channel, 1)) for channel in bag.channels]
        for message in bag.messages():
            channel = bag.channels[message.channel]
            if channel.type_name not in store.fielddefs or "std_msgs/Header" in channel.definition:
                continue
            expected = bytes(store.cdr_to_ros1(message.raw, channel.type_name))
            assert ways[message.channel].convert(message.raw) == expected
            compared += 1
    assert compared > 50


def _without_seq(channel: Channel, raw: bytes) -> bytes:
    if channel.ros == 2:
        return canonical(channel, raw)
    serializer = Serializer(channel, "json")
    tree = json.loads(serializer.encode(raw))
    _zero(tree)
    return serializer.decode(json.dumps(tree).encode())


def _zero(tree: object) -> None:
    if isinstance(tree, list):
        for item in tree:
            _zero(item)
    elif isinstance(tree, dict):
        if tree.keys() == {"seq", "stamp", "frame_id"}:
            tree["seq"] = 0
        for value in tree.values():
            _zero(value)
