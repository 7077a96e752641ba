"""Real rospy clients and servers on loopback."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator

import pytest

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import CallFailed, EndpointError, RequestReceived, ResponseReceived, Role
from proxy.serial.channel import Channel, Service
from tests.proxy.endpoints.ros1_net import Ear, Net, ros1_net

SET_BOOL = "std_srvs/srv/SetBool"
SET_BOOL_MD5 = "09fb03525b03e7ea1fd3992bafd87e16"

SERVER = """
import os, threading
from std_srvs.srv import SetBool, SetBoolResponse
rospy.init_node("server")
gate = threading.Event()
def flag(request):
    if not request.data:
        raise rospy.ServiceException("no falsehoods")
    return SetBoolResponse(True, "fine")
def slow(request):
    print("asked")
    gate.wait()
    return SetBoolResponse(True, "at last")
rospy.Service("/flag", SetBool, flag)
rospy.Service("/slow", SetBool, slow)
print("ready")
input()
gate.set()
rospy.spin()
"""

CLIENTS = """
import threading
from std_srvs.srv import SetBool
rospy.init_node("client")
rospy.wait_for_service("/virtual", 10)
def call(number):
    try:
        response = rospy.ServiceProxy("/virtual", SetBool)(number % 2 == 0)
        print(number, response.success, response.message)
    except rospy.ServiceException as error:
        print(number, error)
threads = [threading.Thread(target=call, args=(number,)) for number in range({count})]
print("ready")
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print("done")
"""


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    with ros1_net(tmp_path_factory.mktemp("ros")) as net:
        yield net


@pytest.fixture
def ear(net: Net) -> Iterator[Ear]:
    yield net.endpoint()
    net.leave()


def fine(text: str, *, success: bool = True) -> bytes:
    return struct.pack("<?I", success, len(text)) + text.encode()


def set_bool(name: str = "/virtual", md5: str = SET_BOOL_MD5) -> Service:
    request = Channel(name, f"{SET_BOOL}_Request", 1, hash="", definition="bool data\n", definition_format="msg")
    response = Channel(
        name, f"{SET_BOOL}_Response", 1, hash="", definition="bool success\nstring message\n", definition_format="msg"
    )
    return Service(name, SET_BOOL, md5, request, response)


def test_a_local_server_answers_byte_for_byte_and_its_refusal_is_the_reason(net: Net, ear: Ear) -> None:
    net.peer(SERVER)
    ear.wait_end("/flag")
    (end,) = (end for end in ear.endpoint.graph() if end.name == "/flag")
    assert (end.role, end.type_name, end.node, end.hash) == (Role.SERVES, SET_BOOL, "/server", SET_BOOL_MD5)
    dial = ear.endpoint.create_client("/flag", SET_BOOL)
    for call in range(4):
        ear.endpoint.call(dial, call, bytes([call % 2]))
    answers = ear.wait(ResponseReceived, 2, dial)
    failures = ear.wait(CallFailed, 2, dial)
    assert {(event.call, event.raw) for event in answers} == {(1, fine("fine")), (3, fine("fine"))}
    assert {(event.call, event.reason) for event in failures} == {(0, "no falsehoods"), (2, "no falsehoods")}


def test_fifty_calls_under_way_at_once_are_all_answered(net: Net, ear: Ear) -> None:
    server = net.peer(SERVER)
    ear.wait_end("/slow")
    dial = ear.endpoint.create_client("/slow", SET_BOOL)
    for call in range(50):
        ear.endpoint.call(dial, call, b"\1")
    for _ in range(50):
        assert server.line() == "asked"
    server.tell("go")
    assert sorted(event.call for event in ear.wait(ResponseReceived, 50, dial)) == list(range(50))


def test_a_server_that_dies_in_mid_call_fails_the_call_and_its_successor_is_called(net: Net, ear: Ear) -> None:
    server = net.peer(SERVER)
    ear.wait_end("/slow")
    dial = ear.endpoint.create_client("/slow", SET_BOOL)
    ear.endpoint.call(dial, 1, b"\1")
    assert server.line() == "asked"
    server.end(kindly=False)
    assert ear.wait(CallFailed, 1, dial)[0].call == 1
    successor = net.peer(SERVER)
    ear.endpoint.call(dial, 2, b"\1")
    assert successor.line() == "asked"
    successor.tell("go")
    assert ear.wait(ResponseReceived, 1, dial)[0] == ResponseReceived(dial, 2, fine("at last"))


def test_a_dropped_call_is_never_answered_and_does_not_hold_up_the_next(net: Net, ear: Ear) -> None:
    server = net.peer(SERVER)
    ear.wait_end("/slow")
    dial = ear.endpoint.create_client("/slow", SET_BOOL)
    ear.endpoint.call(dial, 1, b"\1")
    assert server.line() == "asked"
    ear.endpoint.drop(dial, 1)
    server.tell("go")
    ear.endpoint.call(dial, 2, b"\1")
    assert ear.wait(ResponseReceived, 1, dial) == [ResponseReceived(dial, 2, fine("at last"))]
    assert not ear.of(CallFailed)


def test_a_service_that_is_not_there_fails_at_once(ear: Ear) -> None:
    dial = ear.endpoint.create_client("/nowhere", SET_BOOL)
    ear.endpoint.call(dial, 1, b"\1")
    assert "unavailable" in ear.wait(CallFailed, 1, dial)[0].reason


def test_a_server_of_another_type_does_not_answer_for_the_one_dialled(net: Net, ear: Ear) -> None:
    net.peer(SERVER)
    dial = ear.endpoint.create_client("/flag", "std_srvs/srv/Trigger")
    ear.endpoint.call(dial, 1, b"")
    assert "std_srvs/SetBool" in ear.wait(CallFailed, 1, dial)[0].reason


def test_fifty_local_clients_at_once_are_answered_or_refused_with_the_reason(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.serve(set_bool())
    clients = net.peer(CLIENTS.format(count=50))
    asked = ear.wait(RequestReceived, 50, handle)
    assert len({event.ticket for event in asked}) == 50
    for event in asked:
        if event.raw == b"\1":
            ear.endpoint.answer(handle, event.ticket, fine("yes"))
        else:
            ear.endpoint.refuse(handle, event.ticket, "no server")
    ear.until(lambda: not ear.endpoint._rospy.link.is_behind)
    lines = set()
    while (line := clients.line()) != "done":
        lines.add(line)
    assert {line for line in lines if int(line.split()[0]) % 2 == 0} == {
        f"{number} True yes" for number in range(0, 50, 2)
    }
    assert sum("no server" in line for line in lines) == 25
    ear.endpoint.answer(handle, asked[0].ticket, fine("too late"))


def test_closing_a_server_fails_who_waits(net: Net, ear: Ear) -> None:
    handle = ear.endpoint.serve(set_bool(md5=""))
    client = net.peer(CLIENTS.format(count=1))
    ear.wait(RequestReceived)
    ear.endpoint.close(handle)
    assert "no longer offered" in client.line()


def test_a_service_that_is_served_here_is_a_fault_until_its_server_leaves(net: Net, ear: Ear) -> None:
    server = net.peer(SERVER)
    ear.wait_end("/flag")
    handle = ear.endpoint.serve(set_bool("/flag"))
    assert "/server" in ear.wait(EndpointError, 1, handle)[0].reason
    server.end(kindly=False)
    net.peer(CLIENTS.format(count=1).replace("/virtual", "/flag"))
    asked = ear.wait(RequestReceived, 1, handle)[0]
    ear.endpoint.answer(handle, asked.ticket, fine(""))


def test_a_service_whose_definition_differs_from_the_installed_one_is_a_fault(ear: Ear) -> None:
    handle = ear.endpoint.serve(set_bool(md5="0" * 32))
    assert SET_BOOL_MD5 in ear.wait(EndpointError, 1, handle)[0].reason


def test_a_service_type_that_is_not_installed_is_served_by_its_definitions(net: Net, ear: Ear) -> None:
    far = set_bool("/far", md5="")
    ear.endpoint.serve(Service("/far", "far_srvs/srv/Far", "", far.request, far.response))
    other = net.endpoint("far_looker")
    other.wait_end("/far")
    (end,) = (end for end in other.endpoint.graph() if end.name == "/far")
    assert (end.type_name, end.hash) == ("far_srvs/srv/Far", SET_BOOL_MD5)
    opaque = other.endpoint.service("/far", "far_srvs/srv/Far")
    assert (opaque.hash, opaque.request.definition) == (SET_BOOL_MD5, "")


def test_rounds_of_serving_and_calling_leave_no_descriptor_and_no_thread(net: Net, ear: Ear) -> None:
    net.peer(SERVER)
    pid = ear.endpoint._rospy._process.pid

    def rounds(count: int) -> None:
        for _ in range(count):
            serves = ear.endpoint.serve(set_bool())
            dials = [ear.endpoint.create_client("/flag", SET_BOOL) for _ in range(10)]
            for dial in dials:
                ear.endpoint.call(dial, 1, b"\1")
            ear.wait(ResponseReceived, 10)
            for handle in (serves, *dials):
                ear.endpoint.close(handle)
            ear.events.clear()

    def held() -> tuple[int, int]:
        return len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task"))

    ear.wait_end("/flag")
    rounds(2)
    before = held()
    rounds(20)
    ear.until(lambda: all(now <= then + 3 for now, then in zip(held(), before, strict=True)))


def test_an_installed_service_type_is_described_with_both_its_parts(ear: Ear) -> None:
    known = ear.endpoint.service("/any", SET_BOOL)
    assert known.hash == SET_BOOL_MD5
    assert known.request.type_name == f"{SET_BOOL}_Request"
    assert "bool data" in known.request.definition
    assert "string message" in known.response.definition
    with pytest.raises(LocalError, match="no_srvs/srv/Such"):
        ear.endpoint.service("/any", "no_srvs/srv/Such")
