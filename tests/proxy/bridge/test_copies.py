"""Copies of a large message on its way: between the local graph and the sealed frames there are none."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from gdp import burst
from gdp.burst.cipher import Plaintext
from proxy.wire.message import HEAD_BYTES, RosMessage
from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites

CHATTER = f"name: /chatter, type: {STRING}, encoding: cdr"


@pytest.mark.skipif(burst.PLAINTEXT is Plaintext, reason="the twin in Python joins the parts of a message")
def test_a_large_message_takes_its_size_once_as_frames_and_once_as_the_message_that_they_bring(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    ear, talker = Ear(server.graph, "/chatter"), robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    raw = string("x" * 900_000)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        talker.publish(raw)
        assert sites.run(3, lambda: bool(ear.heard))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ear.heard == [raw]
    assert peak - before < 2.5 * len(raw)


def test_the_body_of_a_message_whose_head_came_apart_is_not_copied() -> None:
    ros_message = RosMessage(3, 5, b"x" * 900_000)
    assert len(ros_message.head) == HEAD_BYTES
    assert RosMessage.from_wire(ros_message.body, ros_message.head).body is ros_message.body
