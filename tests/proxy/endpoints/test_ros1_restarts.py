"""Master that is absent, dies or comes back, and a rospy process that is killed."""

from __future__ import annotations

import os
import signal
import sys
import xmlrpc.client
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from lab.process import until
from proxy.endpoints.core.endpoint import CallFailed, EndpointError, MessageReceived, RequestReceived, ResponseReceived
from tests.proxy.endpoints.ros1_net import PATIENCE_S, Ear, Net, ros1_net
from tests.proxy.endpoints.test_ros1 import LISTENER, STRING, TALKER, channel, string
from tests.proxy.endpoints.test_ros1_services import CLIENTS, SERVER, SET_BOOL, fine, set_bool

SLOW_LISTENER = """
import sys
from rospy.impl import tcpros_base
from std_msgs.msg import String
plain = tcpros_base.TCPROSTransport.connect
def connect(*words, **options):  # the first handshake waits for the test, between requestTopic and TCP
    tcpros_base.TCPROSTransport.connect = plain
    print("connecting")
    sys.stdin.readline()
    try: plain(*words, **options)
    except Exception: print("refused"); raise
tcpros_base.TCPROSTransport.connect = connect
rospy.init_node("listener")
rospy.Subscriber("/out", String, lambda message: print(message.data))
print("ready")
rospy.spin()
"""
SLOW_TALKER = """
import sys
from rospy.impl import tcpros_pubsub
from std_msgs.msg import String
plain = tcpros_pubsub.TCPROSHandler.topic_connection_handler
is_first = True
def handle(*words):  # the first handshake finds the publisher gone
    global is_first
    if is_first:
        is_first = False
        talker.unregister()
        print("asked")
    return plain(*words)
tcpros_pubsub.TCPROSHandler.topic_connection_handler = handle
rospy.init_node("talker")
talker = rospy.Publisher("/in", String, queue_size=10, latch=True)
print("ready")
sys.stdin.readline()
talker = rospy.Publisher("/in", String, queue_size=10, latch=True)
talker.publish("again")
rospy.spin()
"""


@pytest.fixture
def net(tmp_path: Path) -> Iterator[Net]:
    with ros1_net(tmp_path) as net:
        yield net


def is_all_there(net: Net, ear: Ear, hears: int, tells: int, serves: int, dial: int) -> None:
    """Check all functions of four handles, with new peers."""
    ear.events.clear()
    net.peer(TALKER.format(node="talker", topic="/in", latch=True))
    assert ear.wait(MessageReceived, 1, hears)[0].raw == string("first of talker")
    listener = net.peer(LISTENER.format(node="listener", topic="/out", type="AnyMsg"))
    assert listener.line().startswith(string("kept").hex())
    ear.until(lambda: ear.endpoint.subscribers(tells) == 1)
    client = net.peer(CLIENTS.format(count=1))
    ear.endpoint.answer(serves, ear.wait(RequestReceived, 1, serves)[0].ticket, fine("yes"))
    assert client.line() == "0 True yes"
    net.peer(SERVER)
    ear.endpoint.call(dial, 99, b"\1")
    ear.until(lambda: ResponseReceived(dial, 99, fine("fine")) in ear.events)


def four(ear: Ear) -> tuple[int, int, int, int]:
    tells = ear.endpoint.advertise(channel("/out", latched=True))
    ear.endpoint.publish(tells, string("kept"))
    hears = ear.endpoint.subscribe("/in", STRING, None)
    return hears, tells, ear.endpoint.serve(set_bool()), ear.endpoint.create_client("/flag", SET_BOOL)


def test_a_master_that_comes_later_is_joined(net: Net) -> None:
    net.stop_master()
    ear = net.endpoint()
    handles = four(ear)
    for handle in handles:
        assert "does not answer" in ear.wait(EndpointError, 1, handle)[0].reason
    net.start_master()
    is_all_there(net, ear, *handles)


def test_a_master_that_was_restarted_gets_everything_again(net: Net) -> None:
    ear = net.endpoint()
    handles = four(ear)
    is_all_there(net, ear, *handles)
    ear.events.clear()
    net.stop_master()
    for handle in handles:
        assert "does not answer" in ear.wait(EndpointError, 1, handle)[0].reason
    net.end_peers()
    net.start_master()
    is_all_there(net, ear, *handles)


def test_a_killed_rospy_process_comes_back_with_everything(net: Net) -> None:
    ear = net.endpoint()
    handles = four(ear)
    is_all_there(net, ear, *handles)
    ear.events.clear()
    net.end_peers()
    server = net.peer(SERVER)
    dial = ear.endpoint.create_client("/slow", SET_BOOL)
    ear.endpoint.call(dial, 7, b"\1")
    server.until("asked")
    os.kill(ear.endpoint._rospy._process.pid, signal.SIGKILL)
    assert ear.wait(CallFailed, 1, dial)[0].call == 7
    for handle in (*handles, dial):
        assert "has ended" in ear.wait(EndpointError, 1, handle)[0].reason
    server.end()
    is_all_there(net, ear, *handles)


def test_a_proxy_that_is_killed_leaves_no_rospy_process_and_no_name_at_the_master(net: Net) -> None:
    code = f"""
import sys
sys.path[:0] = {sys.path!r}
from proxy.endpoints.ros1 import Ros1Endpoint
endpoint = Ros1Endpoint({net.uri!r}, "gdp_proxy_aaaaaaaaaaaa")
endpoint.subscribe("/in", {STRING!r}, None)
print("ready")
input()
"""
    proxy = net.peer(code)
    ear = net.endpoint()
    ear.wait_end("/in", gone=True)
    net.peer(TALKER.format(node="talker", topic="/in", latch=False))
    ear.wait_end("/in", "/gdp_proxy_aaaaaaaaaaaa")
    proxy.end(kindly=False)
    ear.wait_end("/in", "/gdp_proxy_aaaaaaaaaaaa", gone=True)


def test_an_endpoint_shuts_without_a_master_too(net: Net) -> None:
    net.stop_master()
    ear = net.endpoint()
    ear.wait(EndpointError, 1, ear.endpoint.subscribe("/in", STRING, None))
    process = ear.endpoint._rospy._process
    net.leave()
    assert process.returncode == 0


def test_the_rospy_process_ends_with_the_proxy(net: Net) -> None:
    ear = net.endpoint()
    ear.endpoint.advertise(channel("/out"))
    other = net.endpoint("another_node")
    other.wait_end("/out")
    net.endpoints.remove(ear.endpoint)
    process = ear.endpoint._rospy._process
    ear.endpoint.shut_down()
    assert process.returncode == 0
    other.wait_end("/out", gone=True)


def wait_until_unpublished(net: Net, topic: str) -> None:
    """Return when the master knows no publisher of a topic, which causes no event."""
    with xmlrpc.client.ServerProxy(net.uri) as master:
        until(lambda: topic not in str(cast("list[Any]", master.getSystemState("/test"))[2][0]), topic, PATIENCE_S)


def test_a_listener_whose_handshake_met_a_publisher_under_replacement_is_connected_later(net: Net) -> None:
    ear = net.endpoint()
    listener = net.peer(SLOW_LISTENER)
    first = ear.endpoint.advertise(channel("/out", latched=True))
    listener.until("connecting")
    ear.endpoint.close(first)
    wait_until_unpublished(net, "/out")
    listener.tell("go on")
    listener.until("refused")
    second = ear.endpoint.advertise(channel("/out", latched=True))
    ear.endpoint.publish(second, string("heard"))
    ear.until(lambda: ear.endpoint.subscribers(second) == 1)
    listener.until("heard")


def test_a_talker_whose_handshake_met_its_replacement_is_heard_later(net: Net) -> None:
    ear = net.endpoint()
    hears = ear.endpoint.subscribe("/in", STRING, None)
    talker = net.peer(SLOW_TALKER)
    talker.until("asked")
    talker.tell("go on")
    assert ear.wait(MessageReceived, 1, hears)[0].raw == string("again")
