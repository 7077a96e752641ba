"""What runs of ours at A and B: a member of the overlay without ROS.

Place: process of its own, started by ``gdp_net.py``. Each message is written in the topic's encoding, encrypted,
signed, verified, put in order and reported on, and read back from the encoding: all that a proxy does but for ROS.

Each encoding has a topic of its own, ``/ping/json`` for one; answers come back on ``/pong``.
"""

from __future__ import annotations

import os
import secrets
import time
from collections import deque
from pathlib import Path
from typing import Final, get_args

from gdp.client.member import Member, Topic
from gdp.client.publisher import Publisher
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.names import Name
from gdp.nodes.allocator import settle_memory
from gdp.nodes.config import RibConfig
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.nodes.runtime import Runtime
from gdp.ports.raw import RawPlane
from gdp.stores.keyring import load_delegations
from peers.exchange import IMAGE, PATIENCE_S, answer_to, exchange
from peers.jsonl import EndSettings, say
from proxy.serial.channel import Channel
from proxy.serial.serializer import Encoding, Serializer
from proxy.serial.standard import standard_definition

__all__ = ["PONG", "main", "ping_topic"]

PONG: Final = "/pong"
_FOREVER_S: Final = 3_600.0


def ping_topic(encoding: str) -> str:
    """Return the topic that carries messages in an encoding."""
    return f"/ping/{encoding}"


class GdpEnd:
    """A member on its plane."""

    def __init__(self, config: Path, spin_s: float) -> None:
        settings = RibConfig.load(config)  # identity, domain and iface are all that an end needs
        identity, policy = load_member(settings.identity, settings.domain, Role.PROXY)
        self.member = Member(identity, policy, NodeSettings(incarnation(), wall_clock_ms(), secrets.token_bytes))
        self.runtime = Runtime(self.member, RawPlane([settings.iface]), spin_s=spin_s)
        self._topics: dict[str, Topic] = {}
        self._arrived = deque[tuple[Name, bytes]]()
        for each in load_delegations(settings.identity / "delegations"):
            if each.metadata is None:
                raise LocalError("a delegation without metadata")
            grants = {epoch: grant.secret for epoch, grant in each.open(identity).items()}
            self._topics[str(each.metadata["name"])] = Topic(each, grants)

    def advertise(self, topic: str) -> Publisher:
        """Publish a topic, reliably."""
        return self.member.advertise(self._topics[topic], b"bench", reliable=True)

    def subscribe(self, topic: str) -> Name:
        """Read a topic; return its name."""
        self.member.subscribe(self._topics[topic])
        return self._topics[topic].name

    def publish(self, publisher: Publisher, message: bytes) -> None:
        """Publish, and hand the frames to the device."""
        publisher.publish(message)
        self.member.flush(time.monotonic())
        self.runtime.send()

    def receive(self, deadline_s: float) -> tuple[Name, bytes] | None:
        """Return the next message with its topic; None when the monotonic second passed."""
        while not self._arrived:
            if time.monotonic() >= deadline_s or self.runtime.is_stopped:
                return None
            self.runtime.step(deadline_s)
            self._arrived.extend((each.topic, each.delivered.message) for each in self.member.take_messages())
        return self._arrived.popleft()


class GdpWay:
    """A's side of one encoding."""

    def __init__(self, end: GdpEnd, publisher: Publisher, serializer: Serializer) -> None:
        self._end = end
        self._publisher = publisher
        self._serializer = serializer

    def send(self, message: bytes) -> None:
        """Let a message go."""
        self._end.publish(self._publisher, self._serializer.encode(message))

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next answer; None when the monotonic second passed."""
        arrived = self._end.receive(deadline_s)
        return None if arrived is None else arrived[1]


def _serializer(encoding: Encoding) -> Serializer:
    definition = standard_definition(IMAGE)
    if definition is None:
        raise LocalError(f"no definition of {IMAGE}")
    return Serializer(Channel("/bench", IMAGE, 2, definition=definition, definition_format="msg"), encoding)


def _ping(end: GdpEnd, encodings: list[Encoding], settings: EndSettings) -> None:
    publishers = {encoding: end.advertise(ping_topic(encoding)) for encoding in encodings}
    end.subscribe(PONG)
    settle_memory()
    patience_s = time.monotonic() + PATIENCE_S
    if not end.runtime.run(lambda: all(each.readers for each in publishers.values()), patience_s):
        raise TimeoutError("nobody reads: the overlay did not come up")
    pids = {"sender": [os.getpid()], **settings.pids}
    for encoding, publisher in publishers.items():
        sizes = exchange(GdpWay(end, publisher, _serializer(encoding)), settings.load, pids)
        say(series=encoding, sizes=sizes, resent=publisher.repairs)


def _pong(end: GdpEnd, encodings: list[Encoding]) -> None:
    publisher = end.advertise(PONG)
    serializers = {end.subscribe(ping_topic(encoding)): _serializer(encoding) for encoding in encodings}
    with end.runtime.signals():
        say(event="ready")
        while not end.runtime.is_stopped:
            arrived = end.receive(time.monotonic() + _FOREVER_S)
            if arrived is not None:
                topic, body = arrived
                end.publish(publisher, answer_to(serializers[topic].decode(body)))


def main() -> None:
    """Be ``ping`` or ``pong``."""
    settings = EndSettings.from_argument()
    wanted = settings.own["encodings"].split()
    encodings: list[Encoding] = [each for each in get_args(Encoding) if each in wanted]
    end = GdpEnd(Path(settings.own["config"]), float(settings.own["spin_s"]))
    if settings.role == "ping":
        _ping(end, encodings, settings)
    else:
        _pong(end, encodings)


if __name__ == "__main__":
    main()
