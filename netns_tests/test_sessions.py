"""Sessions of the library on real devices: threads, asyncio, failing handlers, and errors that name the remedy."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gdp.trust.right import Right
from lab.process import calling
from netns_tests.session_lab import SessionLab, execute, session_lab

pytestmark = pytest.mark.netns

RIGHTS = {
    "robot": {"a": [Right.PUBLISH], "b": [Right.PUBLISH], "plan": [Right.CALL]},
    "server": {"a": [Right.READ], "b": [Right.READ], "plan": [Right.SERVE]},
}


@pytest.fixture(scope="module")
def lab() -> Iterator[SessionLab]:
    with session_lab(RIGHTS) as lab:
        yield lab


def run(lab: SessionLab, code: str) -> list[str]:
    """Run a program of both nodes to its end and return the lines it printed."""
    head = "import asyncio, threading, time, gdp\n"
    return lab.output(*calling(execute, head + code)).splitlines()


def test_threads_that_publish_and_receive_at_once_lose_nothing(lab: SessionLab) -> None:
    code = """
with gdp.open("robot") as robot, gdp.open("server") as server:
    publishers = [robot.publisher(name) for name in "ab"]
    subscriptions = [server.subscribe(name, queue=2000) for name in "ab"]  # a receiving thread may start late
    for publisher in publishers:
        publisher.wait_for_readers(timeout_s=10)
    got = [[], []]
    def publish(at):
        for number in range(2000):
            publishers[at].put(number.to_bytes(2, "big") * 50)
    def receive(at):
        while len(got[at]) < 2000:
            got[at].append(int.from_bytes(subscriptions[at].receive(10).payload[:2], "big"))
    threads = [threading.Thread(target=work, args=(at,)) for at in (0, 1) for work in (publish, receive)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    print(all(each == list(range(2000)) for each in got))
"""
    assert run(lab, code) == ["True"]


def test_a_large_message_crosses_while_the_program_computes(lab: SessionLab) -> None:
    code = """
with gdp.open("robot") as robot, gdp.open("server") as server:
    publisher, subscription = robot.publisher("a"), server.subscribe("a")
    publisher.wait_for_readers(timeout_s=10)
    publisher.put(bytes(3_000_000))
    while subscription.poll() is None:
        sum(range(1000))
    publisher.flush(10)
    print(publisher.confirmed)
"""
    assert run(lab, code) == ["1"]


def test_a_session_of_asyncio_publishes_serves_and_calls(lab: SessionLab) -> None:
    code = """
async def main():
    async with gdp.open_async("robot") as robot, gdp.open_async("server") as server:
        publisher, subscription = robot.publisher("a"), server.subscribe("a")
        await publisher.wait_for_readers(timeout_s=10)
        await publisher.put(b"hello")
        print((await subscription.receive(10)).payload)
        async def double(request):
            await asyncio.sleep(0.1)
            return request.payload * 2
        server.serve("plan", double, workers=8)
        begun = time.monotonic()
        responses = await asyncio.gather(*(robot.call("plan", b"%d" % n) for n in range(8)))
        print([response.payload for response in responses] == [b"%d%d" % (n, n) for n in range(8)])
        begun = time.monotonic()
        await asyncio.gather(*(robot.call("plan", b"x") for n in range(8)))
        print(time.monotonic() - begun < 0.6)
asyncio.run(main())
"""
    assert run(lab, code) == ["b'hello'", "True", "True"]


def test_the_error_of_a_handler_reaches_the_client(lab: SessionLab) -> None:
    code = """
with gdp.open("robot") as robot, gdp.open("server") as server:
    def fail(request):
        raise ValueError("no map of " + request.payload.decode())
    server.serve("plan", fail)
    try:
        robot.call("plan", b"hall")
    except gdp.CallError as error:
        print(error)
"""
    assert run(lab, code) == ["plan: every server refused: ValueError: no map of hall"]


def test_a_second_session_of_one_node_is_refused(lab: SessionLab) -> None:
    code = """
with gdp.open("robot"):
    try:
        gdp.open("robot")
    except gdp.SessionError as error:
        print(error)
with gdp.open("robot") as again:
    print(again.is_attached)
"""
    first, second = run(lab, code)
    assert "has a session in this process already" in first
    assert second == "True"


def test_a_device_that_is_not_there_is_named(lab: SessionLab) -> None:
    code = """
try:
    gdp.open("robot", iface="none0")
except gdp.LocalError as error:
    print(error)
"""
    (said,) = run(lab, code)
    assert said.startswith("none0: no such device; start gdp-switch")


def test_a_node_without_a_switch_says_what_it_waits_for(lab: SessionLab) -> None:
    code = """
import subprocess
subprocess.run("ip link add lonely0 type veth peer name lonely1; ip link set lonely0 up; ip link set lonely1 up",
               shell=True, check=True)
try:
    gdp.open("robot", iface="lonely0", timeout_s=1)
except gdp.AttachError as error:
    print(error)
"""
    (said,) = run(lab, code)
    assert said == "not attached within 1 s: no neighbour on lonely0: no answer there"
