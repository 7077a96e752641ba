"""Services and the parts of actions, with real rclpy clients and servers in another process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import CallFailed, ResponseReceived, Role
from tests.proxy.endpoints.ros2_net import Ears, Peer, endpoint_of_ours, needs, peer_of

needs("std_srvs", "test_msgs", "action_msgs")

SET_BOOL = "std_srvs/srv/SetBool"
TRUE = b"\0\1\0\0\1\0\0\0"  # SetBool_Request, as Fast CDR writes it
SERVER = """!
from std_srvs.srv import SetBool, Trigger, Empty
import threading, time
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
def answer(request, response):
    response.success, response.message = request.data, 'it is'
    return response
"""


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with peer_of("server") as found:
        found.tell(SERVER)
        yield found


@pytest.fixture
def ears() -> Iterator[Ears]:
    with endpoint_of_ours() as found:
        yield found


def answer_of(success: bool, message: str) -> bytes:
    from rclpy.serialization import serialize_message
    from std_srvs.srv import SetBool

    return bytes(serialize_message(SetBool.Response(success=success, message=message)))


def read(raw: bytes) -> tuple[bool, str]:
    """Compare without padding: Fast CDR leaves its bytes as they are in memory."""
    from rclpy.serialization import deserialize_message
    from std_srvs.srv import SetBool

    response = deserialize_message(raw, SetBool.Response)
    return response.success, response.message


def served(ears: Ears, name: str) -> bool:
    return any(end.role is Role.SERVES and end.name == name for end in ears.endpoint.graph())


def test_the_first_call_of_a_new_client_is_answered(ears: Ears, peer: Peer) -> None:
    peer.tell("!s1 = node.create_service(SetBool, '/s1', answer)")
    ears.until(lambda: served(ears, "/s1"), "the server in the graph")
    handle = ears.endpoint.create_client("/s1", SET_BOOL)
    ears.endpoint.call(handle, 7, TRUE)
    outcome = ears.outcome(handle, 7)
    assert isinstance(outcome, ResponseReceived)
    assert read(outcome.raw) == (True, "it is")


def test_a_call_without_a_server_fails_at_once(ears: Ears) -> None:
    handle = ears.endpoint.create_client("/absent", SET_BOOL)
    ears.endpoint.call(handle, 1, TRUE)
    assert list(ears.endpoint.poll_events())[-1] == CallFailed(handle, 1, "no server of /absent")


def test_bytes_that_are_no_request_fail(ears: Ears, peer: Peer) -> None:
    handle = ears.endpoint.create_client("/absent", "rcl_interfaces/srv/GetParameters")
    ears.endpoint.call(handle, 1, b"\0\1\0\0\xff\xff\xff\xff")
    assert "cannot be read" in str(ears.outcome(handle, 1))


def test_fifty_calls_at_once_each_get_their_own_answer(ears: Ears, peer: Peer) -> None:
    peer.tell("!from test_msgs.srv import BasicTypes\ndef same(q, r):\n r.int32_value = q.int32_value\n return r")
    peer.tell("!s2 = node.create_service(BasicTypes, '/s2', same)")
    from rclpy.serialization import deserialize_message, serialize_message
    from test_msgs.srv import BasicTypes

    ears.until(lambda: served(ears, "/s2"), "the server in the graph")
    handle = ears.endpoint.create_client("/s2", "test_msgs/srv/BasicTypes")
    for call in range(50):
        ears.endpoint.call(handle, call, bytes(serialize_message(BasicTypes.Request(int32_value=call))))
    for call in range(50):
        outcome = ears.outcome(handle, call)
        assert isinstance(outcome, ResponseReceived)
        assert deserialize_message(outcome.raw, BasicTypes.Response).int32_value == call


def test_the_response_of_a_dropped_call_is_ignored(ears: Ears, peer: Peer) -> None:
    peer.tell("!s3 = node.create_service(SetBool, '/s3', answer)")
    ears.until(lambda: served(ears, "/s3"), "the server in the graph")
    handle = ears.endpoint.create_client("/s3", SET_BOOL)
    ears.endpoint.call(handle, 1, TRUE)
    ears.endpoint.drop(handle, 1)
    ears.endpoint.call(handle, 2, TRUE)
    ears.outcome(handle, 2)
    assert [event.call for event in ears.of(ResponseReceived, handle)] == [2]


def test_calls_under_way_fail_when_the_server_dies(ears: Ears) -> None:
    with peer_of("mortal") as mortal:
        mortal.tell(SERVER)
        mortal.tell("!hold = lambda q, r: time.sleep(1)")
        mortal.tell("!sm = node.create_service(SetBool, '/mortal', hold)")
        ears.until(lambda: served(ears, "/mortal"), "the server in the graph")
        handle = ears.endpoint.create_client("/mortal", SET_BOOL)
        ears.endpoint.call(handle, 1, TRUE)
        ears.for_s(0.3)
        mortal.tell("node.destroy_service(sm)")
        outcome = ears.outcome(handle, 1)
    assert outcome == CallFailed(handle, 1, "the server of /mortal is gone")


def test_a_local_client_is_answered_under_its_ticket(ears: Ears, peer: Peer) -> None:
    handle = ears.endpoint.serve(ears.endpoint.service("/v1", SET_BOOL))
    peer.tell("!c1 = node.create_client(SetBool, '/v1'); c1.wait_for_service(5)")
    peer.tell("!f = [c1.call_async(SetBool.Request(data=True)), c1.call_async(SetBool.Request(data=False))]")
    first, second = ears.next_asked(handle, 2)
    assert first.raw[:5] == TRUE[:5]
    ears.endpoint.answer(handle, second.ticket, answer_of(False, "second"))
    ears.endpoint.answer(handle, first.ticket, answer_of(True, "first"))
    ears.endpoint.answer(handle, 999, answer_of(True, "an unknown ticket is ignored"))
    peer.waits_for("[x.done() and x.result().message for x in f]", ["first", "second"])


def test_a_refusal_says_its_reason_where_the_type_can(ears: Ears, peer: Peer) -> None:
    handle = ears.endpoint.serve(ears.endpoint.service("/v2", SET_BOOL))
    mute = ears.endpoint.serve(ears.endpoint.service("/v3", "std_srvs/srv/Empty"))
    peer.tell("!c2 = node.create_client(SetBool, '/v2'); c2.wait_for_service(5)")
    peer.tell("!c3 = node.create_client(Empty, '/v3'); c3.wait_for_service(5)")
    peer.tell("!f2 = c2.call_async(SetBool.Request()); f3 = c3.call_async(Empty.Request())")
    ears.endpoint.refuse(handle, ears.next_asked(handle)[0].ticket, "no server anywhere")
    ears.endpoint.refuse(mute, ears.next_asked(mute)[0].ticket, "no server anywhere")
    peer.waits_for("f2.done() and [f2.result().success, f2.result().message]", [False, "no server anywhere"])
    assert peer.tell("f3.done()") is False


def test_an_answer_that_cannot_be_read_refuses_the_request(ears: Ears, peer: Peer) -> None:
    handle = ears.endpoint.serve(ears.endpoint.service("/v4", SET_BOOL))
    peer.tell("!c4 = node.create_client(SetBool, '/v4'); c4.wait_for_service(5)")
    peer.tell("!f4 = c4.call_async(SetBool.Request())")
    ears.endpoint.answer(handle, ears.next_asked(handle)[0].ticket, b"\0\1\0\0\1\0\0\0\xff\xff\xff\x7f")
    peer.waits_for("f4.done() and f4.result().success", False)


def test_the_hidden_parts_of_an_action_show_and_can_be_called(ears: Ears, peer: Peer) -> None:
    peer.tell(
        "!from test_msgs.action import Fibonacci\nfrom rclpy.action import ActionServer\n"
        "def run(goal):\n goal.succeed()\n return Fibonacci.Result(sequence=[1, 1])\n"
        "server = ActionServer(node, Fibonacci, '/fib', run)"
    )
    ears.until(lambda: served(ears, "/fib/_action/send_goal"), "the action")
    parts = {(end.name, end.type_name) for end in ears.endpoint.graph() if end.name.startswith("/fib/")}
    assert parts == {
        ("/fib/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal"),
        ("/fib/_action/get_result", "test_msgs/action/Fibonacci_GetResult"),
        ("/fib/_action/cancel_goal", "action_msgs/srv/CancelGoal"),
        ("/fib/_action/feedback", "test_msgs/action/Fibonacci_FeedbackMessage"),
        ("/fib/_action/status", "action_msgs/msg/GoalStatusArray"),
    }
    from rclpy.serialization import deserialize_message, serialize_message
    from test_msgs.action import Fibonacci

    goal = Fibonacci.Impl.SendGoalService.Request()
    goal.goal_id.uuid[0] = 9
    send = ears.endpoint.create_client("/fib/_action/send_goal", "test_msgs/action/Fibonacci_SendGoal")
    ears.endpoint.call(send, 1, bytes(serialize_message(goal)))
    outcome = ears.outcome(send, 1)
    assert isinstance(outcome, ResponseReceived)
    assert deserialize_message(outcome.raw, Fibonacci.Impl.SendGoalService.Response).accepted
    ask = Fibonacci.Impl.GetResultService.Request(goal_id=goal.goal_id)
    result = ears.endpoint.create_client("/fib/_action/get_result", "test_msgs/action/Fibonacci_GetResult")
    ears.endpoint.call(result, 1, bytes(serialize_message(ask)))
    outcome = ears.outcome(result, 1)
    assert isinstance(outcome, ResponseReceived)
    got = deserialize_message(outcome.raw, Fibonacci.Impl.GetResultService.Response)
    assert list(got.result.sequence) == [1, 1]


def test_servers_and_clients_show_and_go(ears: Ears, peer: Peer) -> None:
    peer.tell("!s5 = node.create_service(SetBool, '/s5', answer); c5 = node.create_client(SetBool, '/c5')")

    def shown() -> set[tuple[Role, str, str, str]]:
        mine = [end for end in ears.endpoint.graph() if end.name in ("/s5", "/c5")]
        return {(end.role, end.name, end.type_name, end.node) for end in mine}

    both = {(Role.SERVES, "/s5", SET_BOOL, "/server"), (Role.CALLS, "/c5", SET_BOOL, "/server")}
    ears.until(lambda: shown() == both, "both")
    assert served(ears, "/server/get_parameters")
    peer.tell("!node.destroy_service(s5); node.destroy_client(c5)")
    ears.until(lambda: not shown(), "neither")


def test_a_service_of_an_unknown_type_says_what_to_install(ears: Ears) -> None:
    with pytest.raises(LocalError, match="install the package no_such_msgs"):
        ears.endpoint.create_client("/x", "no_such_msgs/srv/Do")
    with pytest.raises(LocalError, match="is not a service"):
        ears.endpoint.service("/x", "std_msgs/msg/String")
