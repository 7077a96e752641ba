"""Endpoint process of GDP at A and B: a session of the library, or a member of the overlay without it.

Process of its own, started by ``systems.py``; or a client and a server without the library, for requests and
responses. Each message is encoded, encrypted, signed, verified, ordered,
acknowledged and decoded. That is all that a proxy does except for ROS.

Each encoding has a topic of its own, ``/ping/json`` for one; answers come back on ``/pong``.
"""

from __future__ import annotations

import os
import signal
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeAlias, get_args

from member_endpoint import End

import gdp
from gdp.errors import LocalError
from gdp.names import Name
from gdp.runtime.busy_poll import SPIN_US
from gdp.runtime.memory_tuning import tune_memory
from peers.exchange import IMAGE, PATIENCE_S, answer_to, exchange
from peers.jsonl import EndSettings, say
from proxy.serial.channel import Channel
from proxy.serial.serializer import Encoding, Serializer
from proxy.serial.standard_types import standard_definition

PONG: Final = "/pong"
_FOREVER_S: Final = 3_600.0


def ping_topic(encoding: str) -> str:
    """Return the topic that carries messages in an encoding."""
    return f"/ping/{encoding}"


class LibraryEndpoint:
    """Session of the library."""

    def __init__(self, config: Path) -> None:
        self.session = gdp.open(config, busy_poll_us=SPIN_US, timeout_s=PATIENCE_S)
        self._publishers: dict[str, gdp.Publisher] = {}
        self._subscriptions: dict[str, gdp.Subscription] = {}

    def advertise(self, topic: str) -> Callable[[bytes], None]:
        """Publish a topic, reliably; return what sends a message."""
        publisher = self._publishers[topic] = self.session.publisher(topic, reliable=True)
        return publisher.put

    def subscribe(self, topic: str) -> None:
        """Read a topic."""
        self._subscriptions[topic] = self.session.subscribe(topic)

    def wait_for_readers(self, deadline_s: float) -> None:
        """Wait until each published topic is read; raises ``TimeoutError``."""
        for publisher in self._publishers.values():
            publisher.wait_for_readers(timeout_s=max(deadline_s - time.monotonic(), 0.0))

    def receive(self, deadline_s: float) -> tuple[str, bytes] | None:
        """Return the next message with its topic; None when the monotonic second passed."""
        try:
            if len(self._subscriptions) == 1:
                ((topic, subscription),) = self._subscriptions.items()
                return topic, subscription.receive(deadline_s - time.monotonic()).payload
            source, message = self.session.receive_any(self._subscriptions.values(), deadline_s - time.monotonic())
        except gdp.SessionTimeoutError:
            return None
        return next(topic for topic, each in self._subscriptions.items() if each is source), message.payload

    def resent(self, topic: str) -> int:
        """Return how many parts of a published topic were sent again."""
        return self._publishers[topic].resent


class UnicastEndpoint:
    """Client or server of a name: a message is a request to the one server, and an answer its response.

    ``is_session``: a session secret authenticates both, instead of signatures.
    """

    def __init__(self, config: Path, *, is_session: bool) -> None:
        self._end = End(config, SPIN_US / 1e6)
        self._is_session = is_session
        self._labels: dict[bytes, str] = {}
        self._called: list[Name] = []
        self._arrived = deque[tuple[str, bytes]]()
        self._asked: tuple[Name, Name] | None = None  # service and client of the newest request

    def advertise(self, topic: str) -> Callable[[bytes], None]:
        """Call a name; answers (``PONG``) go to the client of the newest request instead."""
        if topic == PONG:
            return self._respond
        self._end.call(topic, is_session=self._is_session)
        service = self._end.name_of(topic)
        self._called.append(service)
        self._labels[service] = PONG

        def send(message: bytes) -> None:
            (server,) = self._end.member.peers(service)
            self._end.member.send_request(service, server, message)
            self._flush()

        return send

    def subscribe(self, topic: str) -> None:
        """Serve a name; answers need no subscription."""
        if topic != PONG:
            self._labels[self._end.serve(topic, is_session=self._is_session)] = topic

    def wait_for_readers(self, deadline_s: float) -> None:
        """Wait until each name that is called has a server; raises ``TimeoutError``."""
        if not self._end.runtime.run(lambda: all(map(self._end.member.peers, self._called)), deadline_s):
            raise TimeoutError("no server: the overlay did not come up")

    def receive(self, deadline_s: float) -> tuple[str, bytes] | None:
        """Return the next request or response with its topic; None when the monotonic second passed."""
        while not self._arrived:
            if time.monotonic() >= deadline_s:
                return None
            self._end.runtime.step(deadline_s)
            for each in self._end.member.poll_messages():
                self._asked = each.topic, Name(each.delivered.publisher)
                self._arrived.append((self._labels[each.topic], each.delivered.message))
        return self._arrived.popleft()

    def resent(self, topic: str) -> int:
        """Return how many parts of the streams to all servers were sent again: nothing is sent on them."""
        del topic
        return 0

    def _respond(self, message: bytes) -> None:
        if self._asked is not None:
            self._end.member.respond(*self._asked, message)
            self._flush()

    def _flush(self) -> None:
        self._end.member.flush(time.monotonic())
        self._end.runtime.send()


Endpoint: TypeAlias = "LibraryEndpoint | UnicastEndpoint"


class GdpWay:
    """A's side of one encoding."""

    def __init__(self, end: Endpoint, send: Callable[[bytes], None], serializer: Serializer) -> None:
        self._end = end
        self._send = send
        self._serializer = serializer

    def send(self, message: bytes) -> None:
        """Send a message."""
        self._send(self._serializer.encode(message))

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next answer; None when the monotonic second passed."""
        arrived = self._end.receive(deadline_s)
        return None if arrived is None else arrived[1]


def _serializer(encoding: Encoding) -> Serializer:
    definition = standard_definition(IMAGE)
    if definition is None:
        raise LocalError(f"no definition of {IMAGE}")
    return Serializer(Channel("/bench", IMAGE, 2, definition=definition, definition_format="msg"), encoding)


def _ping(end: Endpoint, encodings: list[Encoding], settings: EndSettings) -> None:
    senders = {encoding: end.advertise(ping_topic(encoding)) for encoding in encodings}
    end.subscribe(PONG)
    tune_memory()
    end.wait_for_readers(time.monotonic() + PATIENCE_S)
    pids = {"sender": [os.getpid()], **settings.pids}
    for encoding, send in senders.items():
        sizes = exchange(GdpWay(end, send, _serializer(encoding)), settings.load, pids)
        say(series=encoding, sizes=sizes, resent=end.resent(ping_topic(encoding)))


def _pong(end: Endpoint, encodings: list[Encoding]) -> None:
    send = end.advertise(PONG)
    serializers = {ping_topic(encoding): _serializer(encoding) for encoding in encodings}
    for topic in serializers:
        end.subscribe(topic)
    tune_memory()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the bench ends it so; there is nothing to release
    say(event="ready")
    while True:
        arrived = end.receive(time.monotonic() + _FOREVER_S)
        if arrived is not None:
            topic, body = arrived
            send(answer_to(serializers[topic].decode(body)))


def endpoint_of(path: str, config: Path) -> Endpoint:
    """Return an endpoint of a kind, as ``GdpNet`` names it."""
    if path == "library":
        return LibraryEndpoint(config)
    return UnicastEndpoint(config, is_session=path == "session")


def main() -> None:
    """Run ``ping`` or ``pong``."""
    settings = EndSettings.from_argument()
    wanted = settings.own["encodings"].split()
    encodings: list[Encoding] = [each for each in get_args(Encoding) if each in wanted]
    end = endpoint_of(settings.own["path"], Path(settings.own["config"]))
    if settings.role == "ping":
        _ping(end, encodings, settings)
    else:
        _pong(end, encodings)


if __name__ == "__main__":
    main()
