"""Member at the end of a network under test: publishes, reads, serves, calls, and records all of it.

Process of its own, started by ``faults.overlay`` with one argument of JSON. Each arrival is appended to a file of
records at once, so that nothing is lost when this process is killed. A message names its channel, its publisher and
the publisher's incarnation, so a message at a wrong reader is detected.
"""

from __future__ import annotations

import json
import random
import signal
import struct
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, Final

from peers.jsonl import say

from faults.records import Kind, RecordWriter
from gdp.client.participant import Message
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.runtime.memory_tuning import tune_memory
from gdp.service.replication import ALL
from gdp.session.protocol.client_core import Call, ClientCore
from gdp.session.protocol.server_core import ServerCore
from lab.end import End

_HEAD: Final = struct.Struct("!8sHHIQ")  # token of the channel, channel, publisher, incarnation, number
_REQUEST: Final = struct.Struct("!8sQ")  # token, number of the call
_BEHIND_S: Final = 0.5  # messages that are overdue for so long are skipped
_LOOK_S: Final = 0.25  # pause between two checks for losses


class Source:
    """Publishes one topic at an even rate."""

    def __init__(
        self, station: End, settings: dict[str, Any], token: bytes, who: tuple[int, int], out: RecordWriter
    ) -> None:
        self._channel, (self._index, self._incarnation_id) = settings["channel"], who
        self._publisher = station.advertise(settings["name"], reliable=settings["reliable"])
        self._token, self._out = token, out
        self._filler = bytes(max(settings["size"] - _HEAD.size, 0))
        self._every_s = 1.0 / float(settings["hz"])
        self.due_s = time.monotonic() + random.random() * self._every_s
        self._number = 0
        self._readers = -1

    def go_on(self, now_s: float) -> None:
        """Publish all messages that are due."""
        readers = self._publisher.readers
        if readers != self._readers:
            self._readers = readers
            self._out.add(Kind.READERS, self._channel, self._incarnation_id, 0, readers, time.monotonic_ns())
        if now_s - self.due_s > _BEHIND_S:
            self.due_s = now_s
        while self.due_s <= now_s:
            self._number += 1
            head = _HEAD.pack(self._token, self._channel, self._index, self._incarnation_id, self._number)
            self._out.add(
                Kind.PUBLISHED, self._channel, self._incarnation_id, self._index, self._number, time.monotonic_ns()
            )
            self._publisher.publish(head + self._filler)
            self.due_s += self._every_s


class Caller:
    """Caller of one service at an even rate: all replicas receive the request, the first response counts."""

    def __init__(
        self, station: End, settings: dict[str, Any], token: bytes, incarnation_id: int, out: RecordWriter
    ) -> None:
        self._token, self._out, self._incarnation_id = token, out, incarnation_id
        self._channel, self._timeout_s = settings["channel"], float(settings["timeout_s"])
        name = settings["name"]
        self._client = ClientCore(station.member, station.topics[name], name, start=random.getrandbits(62))
        self._every_s = 1.0 / float(settings["hz"])
        self.due_s = time.monotonic() + random.random() * self._every_s
        self._count = 0
        self._under_way: dict[int, Call] = {}

    def next_s(self) -> float:
        """Return the next deadline, in monotonic seconds."""
        timer_s = self._client.get_timer()
        return self.due_s if timer_s is None else min(self.due_s, timer_s)

    def go_on(self, now_s: float) -> None:
        """Make the calls that are due, and record those that have ended."""
        timer_s = self._client.get_timer()
        if timer_s is not None and now_s >= timer_s:
            self._client.handle_timer(now_s)
        if now_s >= self.due_s:
            self.due_s = max(self.due_s + self._every_s, now_s - _BEHIND_S)
            self._count += 1
            request = _REQUEST.pack(self._token, self._count)
            call = self._under_way[self._count] = Call(payload=request, timeout_s=self._timeout_s, replication=ALL)
            self._note(Kind.CALLED, self._count)
            self._client.begin(call, now_s)
        for number, call in list(self._under_way.items()):
            if call.is_done:
                del self._under_way[number]
                self._note(Kind.FAILED if call.response is None else Kind.ANSWERED, number)
                if call.response is not None and call.response.payload != call.payload:
                    self._note(Kind.WRONG, number)

    def take(self, message: Message, now_s: float) -> None:
        """Handle a server's response."""
        self._client.receive(message, now_s)

    def _note(self, kind: Kind, number: int) -> None:
        self._out.add(kind, self._channel, self._incarnation_id, 0, number, time.monotonic_ns())


class Reading:
    """Messages received on one topic."""

    def __init__(self, channel: int, token: bytes, out: RecordWriter) -> None:
        self._channel, self._token, self._out = channel, token, out
        self._reported_counts = Counter[LossReason]()
        self._look_at_s = 0.0

    def look(self, station: End, name: Name, now_s: float) -> None:
        """Record reported losses, at intervals."""
        if now_s < self._look_at_s:
            return
        self._look_at_s = now_s + _LOOK_S
        settings = Counter(station.member.subscriptions.losses_of(name).counts)
        for reason, number in (settings - self._reported_counts).items():
            self._out.add(Kind.LOST, self._channel, 0, reason, number, time.monotonic_ns())
        self._reported_counts = settings

    def take(self, message: Message, now_s: float) -> None:
        """Record a message; one of another channel counts as wrong."""
        del now_s
        token, channel, publisher, incarnation_id, number = _HEAD.unpack_from(message.delivered.message)
        at_ns = time.monotonic_ns()
        if token != self._token or channel != self._channel:
            self._out.add(Kind.WRONG, self._channel, 0, channel, number, at_ns)
        else:
            self._out.add(Kind.DELIVERED, self._channel, incarnation_id, publisher, number, at_ns)


class Server:
    """Server that echoes each request of its channel."""

    def __init__(self, station: End, name: str, token: bytes) -> None:
        self._core = ServerCore(station.member, station.topics[name], start=random.getrandbits(62), at_once=None)
        self._token = token

    def go_on(self, now_s: float) -> None:
        """Drop requests that no client waits for."""
        timer_s = self._core.get_timer()
        if timer_s is not None and now_s >= timer_s:
            self._core.handle_timer(now_s)

    def take(self, message: Message, now_s: float) -> None:
        """Answer a client; a client that has gone meanwhile gets nothing."""
        self._core.receive(message, now_s)
        while self._core.turns:
            turn = self._core.turns.popleft()
            is_ours = turn.request.startswith(self._token)
            self._core.finish(turn.number, turn.request if is_ours else "a request of another channel", now_s)


def main() -> None:
    """Run as a member until ended."""
    settings: dict[str, Any] = json.loads(sys.argv[1])
    out, incarnation_id = RecordWriter(Path(settings["records"])), settings["incarnation_id"]
    tokens = {int(channel): bytes.fromhex(token) for channel, token in settings["tokens"].items()}
    station = End.from_config(Path(settings["config"]), 0.0)
    takers: dict[Name, Reading | Server | Caller] = {}
    for each in settings["read"]:
        takers[station.subscribe(each["name"])] = Reading(each["channel"], tokens[each["channel"]], out)
    for each in settings["serve"]:
        takers[station.name_of(each["name"])] = Server(station, each["name"], tokens[each["channel"]])
    remote_clients = [Caller(station, each, tokens[each["channel"]], incarnation_id, out) for each in settings["call"]]
    for each, caller in zip(settings["call"], remote_clients, strict=True):
        takers[station.name_of(each["name"])] = caller
    who = settings["index"], incarnation_id
    sources = [Source(station, each, tokens[each["channel"]], who, out) for each in settings["publish"]]
    spare = iter(settings["spare"])

    def begin_spare(*_: object) -> None:
        """Start the next spare flow."""
        each = next(spare)
        token = tokens[each["channel"]]
        if each["publishes"]:
            sources.append(Source(station, each, token, who, out))
        else:
            takers[station.subscribe(each["name"])] = Reading(each["channel"], token, out)

    signal.signal(signal.SIGUSR1, begin_spare)
    tune_memory()
    with station.runtime.signals():
        say(event="ready")
        while not station.runtime.is_stopped:
            now_s = time.monotonic()
            for source in sources:
                source.go_on(now_s)
            for name, taker in takers.items():
                if isinstance(taker, Reading):
                    taker.look(station, name, now_s)
                else:
                    taker.go_on(now_s)
            station.member.flush(now_s)
            out.flush()
            due = [each.due_s for each in sources] + [each.next_s() for each in remote_clients]
            station.runtime.step(min([*due, now_s + _LOOK_S]))
            now_s = time.monotonic()
            for message in station.member.poll_messages():
                takers[message.topic].take(message, now_s)
        out.flush()
        station.leave()


if __name__ == "__main__":
    main()
