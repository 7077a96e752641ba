"""Events of QoS at far nodes of rclpy: missed deadlines and lost liveliness cross; what cannot cross is reported."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Final

import pytest

from lab.process import until
from netns_tests.live_pair import PATIENCE_S, Crossing, Pair, pair_of
from tests.proxy.endpoints.ros2_net import needs

needs("std_msgs")
pytestmark = [pytest.mark.netns, pytest.mark.momentary("about silence, no lease matters")]

BEAT: Final = Crossing("/beat", "std_msgs/msg/Int32", "a", "b")
_TALKER: Final = """
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import QoSProfile
from std_msgs.msg import Int32
missed = []
out = node.create_publisher(
    Int32, '/beat', QoSProfile(depth=10, deadline=Duration(seconds=2), liveliness_lease_duration=Duration(seconds=2)),
    event_callbacks=PublisherEventCallbacks(deadline=lambda event: missed.append(event.total_count)))
timer = node.create_timer(0.1, lambda: out.publish(Int32(data=7)))
"""
_READERS: Final = """
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import LivelinessPolicy, QoSProfile
from std_msgs.msg import Int32
got, missed, odd, alive = {}, {}, {}, {}
def read(name, **policies):
    got[name], missed[name], odd[name], alive[name] = [], [], [], []
    events = SubscriptionEventCallbacks(
        liveliness=lambda event: alive[name].append(event.alive_count),
        deadline=lambda event: missed[name].append(event.total_count),
        incompatible_qos=lambda event: odd[name].append(str(event.last_policy_kind)))
    kept.append(node.create_subscription(
        Int32, '/beat', lambda message: got[name].append(message.data), QoSProfile(depth=10, **policies),
        event_callbacks=events))
read('deadline', deadline=Duration(seconds=3))
read('lease', liveliness_lease_duration=Duration(seconds=3))
"""


@pytest.fixture
def pair() -> Iterator[Pair]:
    with pair_of(BEAT) as made:
        yield made


def test_a_missed_deadline_is_an_event_at_a_far_reader_and_what_cannot_cross_is_reported(pair: Pair) -> None:
    talker, reader = pair.node("a", "talker"), pair.node("b", "reader")
    talker.tell("!" + _TALKER)
    reader.tell("!" + _READERS)
    until(lambda: reader.tell("len(got['deadline'])"), "messages for who requests a deadline", PATIENCE_S)
    assert reader.tell("len(missed['deadline'])") == 0
    assert pair.proxy("b").warnings("/beat") == []
    talker.tell("!timer.cancel()")
    until(lambda: reader.tell("missed['deadline']"), "the event of a missed deadline", PATIENCE_S)
    assert talker.tell("missed")
    talker.tell("!timer.reset()")
    count = reader.tell("len(got['deadline'])")
    until(lambda: reader.tell("len(got['deadline'])") > count, "messages again", PATIENCE_S)  # type: ignore[operator]

    reader.tell("!read('strict', deadline=Duration(seconds=1))")
    reader.tell("!read('short', liveliness_lease_duration=Duration(seconds=1))")
    reader.tell("!read('manual', liveliness=LivelinessPolicy.MANUAL_BY_TOPIC)")
    for name, policy in (("strict", "DEADLINE"), ("short", "LIVELINESS"), ("manual", "LIVELINESS")):
        until(lambda: reader.tell(f"odd['{name}']"), f"the event of {name}", PATIENCE_S)  # noqa: B023
        assert policy in str(reader.tell(f"odd['{name}']"))
    until(lambda: pair.proxy("b").faults("qos") >= 3, "warnings", PATIENCE_S)
    assert "will get nothing: it requests" in pair.proxy("b").warnings("/beat")[0]
    assert [reader.tell(f"got['{name}']") for name in ("strict", "short", "manual")] == [[], [], []]


@pytest.mark.parametrize("ends", ["machine", "node"])
def test_a_reader_far_away_learns_by_deadline_and_lease_that_the_publisher_is_gone(pair: Pair, ends: str) -> None:
    talker, reader = pair.node("a", "talker"), pair.node("b", "reader")
    talker.tell("!" + _TALKER)
    reader.tell("!" + _READERS)
    until(lambda: reader.tell("len(got['deadline']) and len(got['lease'])"), "messages", PATIENCE_S)
    assert reader.tell("alive['lease'][-1:]") == [1]
    if ends == "node":
        talker.end()
    else:
        pair.proxy("a").end(signal.SIGKILL)
    until(lambda: reader.tell("missed['deadline']"), "the event of a missed deadline", PATIENCE_S)
    until(lambda: reader.tell("alive['lease'][-1:]") == [0], "the event of lost liveliness", PATIENCE_S)
    if ends == "node":
        again = pair.node("a", "talker_again")
        again.tell("!" + _TALKER)
        until(lambda: reader.tell("alive['lease'][-1:]") == [1], "the event of a publisher", PATIENCE_S)
