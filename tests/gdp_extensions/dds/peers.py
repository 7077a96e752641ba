"""Peers of endpoint ``dds``, each in a child process: a node of rclpy, and a second ``DdsEndpoint``.

Commands come as lines of JSON and news go the same way, so that a test waits for the answer it requested. A peer ends
its input. All traffic stays on the loopback device.
"""

from __future__ import annotations

import hashlib
import json
import os
import select
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from lab.process import until
from proxy.endpoints.core.endpoint import Event, GraphEntity, Role

if TYPE_CHECKING:
    from gdp_extensions.dds.endpoint import DdsEndpoint

__all__ = ["CYCLONE", "Ears", "Peer", "digest", "peer"]

CYCLONE = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
    "</Discovery></Domain></CycloneDDS>"
)
PATIENCE_S = 20.0


def digest(raw: bytes) -> str:
    """Return a digest that distinguishes two messages in few characters."""
    return hashlib.sha256(raw).hexdigest()[:16]


class Peer:
    """Process of a peer, seen from a test."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self.heard: list[dict[str, object]] = []
        assert process.stdin is not None
        assert process.stdout is not None
        self._in, self._out = process.stdin, process.stdout
        self._lines = deque[bytes]()
        self._rest = b""

    def tell(self, do: str, **what: object) -> None:
        """Give a command."""
        self._in.write(json.dumps({"do": do, **what}).encode() + b"\n")
        self._in.flush()

    def ask(self, do: str, **what: object) -> dict[str, object]:
        """Give a command and return its response; other news go to ``heard``."""
        self.tell(do, **what)
        while True:
            news = self.read()
            if news.get("answer") == do:
                return news
            self.heard.append(news)

    def read(self) -> dict[str, object]:
        """Return the next line."""
        while not self._lines:
            if not select.select([self._out], [], [], PATIENCE_S)[0]:
                raise TimeoutError("the peer is silent")
            more = os.read(self._out.fileno(), 65_536)
            if not more:
                raise EOFError("the peer is gone")
            *lines, self._rest = (self._rest + more).split(b"\n")
            self._lines += lines
        found = json.loads(self._lines.popleft())
        assert isinstance(found, dict)
        return found

    def end(self) -> None:
        """Let it end."""
        self._in.close()

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()

    def wait_heard(self, topic: str, count: int) -> list[object]:
        """Return the digests of the messages received on a topic, as soon as there are this many."""
        return [news["digest"] for news in self.wait_news("heard", topic, count)]

    def wait_news(self, kind: str, value: object, count: int) -> list[dict[str, object]]:
        """Return the news of a kind, as soon as there are this many; a value of None fits any."""
        while True:
            found = [news for news in self.heard if kind in news and value in (None, news[kind])]
            if len(found) >= count:
                return found
            self.heard.append(self.read())


class Ears:
    """Endpoint of a test, with waits for its conditions."""

    def __init__(self, endpoint: DdsEndpoint) -> None:
        self.endpoint = endpoint

    def wait(self, holds: Callable[[list[Event]], bool]) -> list[Event]:
        """Poll events until a condition on them holds."""
        events = list[Event]()

        def poll() -> None:
            """Wait for events."""
            select.select([self.endpoint.fileno()], [], [], 0.1)
            events.extend(self.endpoint.poll_events())

        until(lambda: holds(events), lambda: (events, self.endpoint.graph()), PATIENCE_S, poll)
        return events

    def wait_end(self, role: Role, name: str) -> GraphEntity:
        """Return a graph entity, as soon as it is in the graph."""
        found: list[GraphEntity] = []

        def is_there(_: list[Event]) -> bool:
            found[:] = [end for end in self.endpoint.graph() if (end.role, end.name) == (role, name)]
            return bool(found)

        self.wait(is_there)
        return found[0]


@contextmanager
def peer(kind: str, domain: int) -> Iterator[Peer]:
    """Run a peer: ``rclpy`` or ``dds``."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
        "CYCLONEDDS_URI": CYCLONE,
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.gdp_extensions.dds.peers", kind, str(domain)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    )
    found = Peer(process)
    try:
        assert found.read() == {"answer": "ready"}
        yield found
    finally:
        if process.poll() is None:
            found.end()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _say(**news: object) -> None:
    print(json.dumps(news), flush=True)


def _lines() -> Iterator[dict[str, object] | None]:
    """Yield commands, and None every few milliseconds without one; end with the input."""
    buffer = b""
    while True:
        if not select.select([0], [], [], 0)[0]:
            yield None
            continue
        more = os.read(0, 65_536)
        if not more:
            return
        *lines, buffer = (buffer + more).split(b"\n")
        for line in lines:
            yield json.loads(line)


def _rclpy_peer() -> None:
    import importlib

    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.serialization import serialize_message

    rclpy.init()
    node = rclpy.create_node("robot")
    publishers, keep = {}, []

    def kind(name: str) -> type:
        package, subpackage, short = name.split("/")
        found = getattr(importlib.import_module(f"{package}.{subpackage}"), short)
        assert isinstance(found, type)
        return found

    def profile(command: dict[str, object]) -> QoSProfile:
        latched = DurabilityPolicy.TRANSIENT_LOCAL if command.get("latched") else DurabilityPolicy.VOLATILE
        return QoSProfile(depth=10, durability=latched)

    def hear(topic: str) -> Callable[[bytes], None]:
        return lambda raw: _say(heard=topic, size=len(raw), digest=digest(raw))

    _say(answer="ready")
    for command in _lines():
        rclpy.spin_once(node, timeout_sec=0.01)
        if command is None:
            continue
        do, topic = command["do"], str(command.get("topic", ""))
        if do == "advertise":
            publishers[topic] = node.create_publisher(kind(str(command["type"])), topic, profile(command))
        elif do == "publish":
            publishers[topic].publish(bytes.fromhex(str(command["hex"])))
        elif do == "image":
            from sensor_msgs.msg import Image

            image = Image(height=480, width=640, encoding="rgb8", step=1920, data=os.urandom(921_600))
            raw = serialize_message(image)
            publishers[topic].publish(raw)
            _say(answer="image", size=len(raw), digest=digest(raw))
        elif do == "subscribe":
            heard_type = kind(str(command["type"]))
            keep.append(node.create_subscription(heard_type, topic, hear(topic), profile(command), raw=True))
            _say(answer="subscribe")
        elif do == "serve":
            keep.append(node.create_service(kind(str(command["type"])), topic, lambda _, response: response))
            _say(answer="serve")
        elif do == "call":
            client = node.create_client(kind(str(command["type"])), topic)
            client.wait_for_service(10)
            client.call_async(client.srv_type.Request())
            keep.append(client)
            _say(answer="call")
        elif do == "graph":
            ends = [
                [each.node_name, each.topic_type, str(each.topic_type_hash), each.qos_profile.durability.name]
                for each in node.get_publishers_info_by_topic(topic)
            ]
            _say(answer="graph", nodes=node.get_node_names(), ends=ends, services=node.get_service_names_and_types())
        elif do == "leave":
            return


def _dds_peer(domain: int) -> None:
    from gdp_extensions.dds.endpoint import DdsEndpoint
    from proxy.endpoints.core.endpoint import CallFailed, RequestReceived, ResponseReceived
    from proxy.serial.channel import Channel, Service

    endpoint = DdsEndpoint(domain, "robot")
    handles: dict[str, int] = {}
    mute = set[int]()
    _say(answer="ready")
    for command in _lines():
        if command is None:
            select.select([endpoint.fileno(), 0], [], [], 0.1)
        for event in endpoint.poll_events():
            if isinstance(event, RequestReceived) and event.handle not in mute:
                endpoint.answer(event.handle, event.ticket, event.raw)
            elif isinstance(event, ResponseReceived):
                _say(answered=event.call, raw=event.raw.hex())
            elif isinstance(event, CallFailed):
                _say(failed=event.call, reason=event.reason)
        if command is None:
            continue
        do, name = command["do"], str(command.get("topic", ""))
        if do == "serve":
            halves = [Channel(name, f"{command['type']}_{half}", 2) for half in ("Request", "Response")]
            handles[name] = endpoint.serve(Service(name, str(command["type"]), "", halves[0], halves[1]))
            if command.get("mute"):
                mute.add(handles[name])
        elif do == "dial":
            handles[name] = endpoint.create_client(name, str(command["type"]))
        elif do == "call":
            endpoint.call(handles[name], int(str(command["call"])), bytes.fromhex(str(command["hex"])))
        elif do == "close":
            endpoint.close(handles.pop(name))
        elif do == "graph":
            _say(answer="graph", ends=[[end.name, end.role.value, end.node] for end in endpoint.graph()])
    endpoint.shut_down()


if __name__ == "__main__":
    if sys.argv[1] == "rclpy":
        _rclpy_peer()
    else:
        _dds_peer(int(sys.argv[2]))
