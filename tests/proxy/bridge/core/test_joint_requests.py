"""Requests that wait for equal ones: calls that are over are forgotten, and count no more."""

from __future__ import annotations

from gdp.names import Name
from gdp.service.serving import Asked, Serving
from proxy.bridge.core.joint_requests import JointRequests

A, B, C = (Name(bytes([each]) * 32) for each in (1, 2, 3))


def test_requests_that_found_no_partner_are_forgotten_with_their_calls() -> None:
    serving = Serving[bytes](1)
    joint = JointRequests(2, serving)
    for number in range(1_000):
        joint.add(float(number), 1.0, Asked(A, 0, number), b"%d" % number)
        serving.expired(float(number) + 1.0)
    assert len(joint._groups) <= 64
    assert serving.poll_turns(1_000.0) == []


def test_a_released_call_that_was_stopped_before_its_turn_executes_nothing() -> None:
    serving = Serving[bytes](1, at_once=1)
    joint = JointRequests(2, serving)
    joint.add(0.0, 9.0, Asked(A, 0, 1), b"go")
    joint.add(0.0, 9.0, Asked(B, 0, 1), b"go")
    serving.stop(Asked(B, 0, 1))
    assert serving.poll_turns(0.0) == []
    assert [each.asked for each in serving.expired(9.0)] == [Asked(A, 0, 1)]


def test_the_partners_of_a_call_get_its_end_also_where_its_own_client_went() -> None:
    serving = Serving[bytes](1)
    joint = JointRequests(2, serving)
    joint.add(0.0, 9.0, Asked(A, 0, 1), b"go")
    joint.add(0.0, 9.0, Asked(B, 0, 1), b"go")
    joint.add(0.0, 9.0, Asked(C, 0, 1), b"go")
    (turn,) = serving.poll_turns(0.0)
    serving.remove_client(B)
    assert serving.end(turn.number) is None
    assert joint.end_partners(turn.number) == [Asked(A, 0, 1)]
    assert Asked(C, 0, 1) in serving
