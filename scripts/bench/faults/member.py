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
from functools import partial
from pathlib import Path
from typing import Any, Final

from peers.jsonl import say

from faults.records import Kind, RecordWriter
from gdp.client.participant import Message
from gdp.errors import LocalError
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.runtime.memory_tuning import tune_memory
from gdp.service.dispatch import Ask, Dispatch, Failure
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
        self._stream, self._name = station.call(settings["name"]), station.name_of(settings["name"])
        self._dispatch: Dispatch[int] = Dispatch(start=random.getrandbits(62))
        self._services, self._every_s = station.member.services, 1.0 / float(settings["hz"])
        self.due_s = time.monotonic() + random.random() * self._every_s
        self._count = 0

    def next_s(self) -> float:
        """Return the next deadline, in monotonic seconds."""
        timer_s = self._dispatch.get_timer()
        return self.due_s if timer_s is None else min(self.due_s, timer_s)

    def go_on(self, now_s: float) -> None:
        """Discover servers, make the calls that are due, end those that time out."""
        peers = set(self._services.peers(self._name) or self._services.connected_peers(self._name))
        for server in set(self._dispatch.servers) - peers:
            self._dispatch.replica_lost(server, now_s, "gone")
        for server in peers:
            self._dispatch.replica_joined(server, now_s)
        self._dispatch.handle_timer(now_s)
        if now_s >= self.due_s:
            self.due_s = max(self.due_s + self._every_s, now_s - _BEHIND_S)
            self._begin(now_s)
        self._send(now_s)

    def take(self, message: Message, now_s: float) -> None:
        """Handle a server's response."""
        if not message.private:
            return
        token, number = _REQUEST.unpack_from(message.delivered.message)
        if token != self._token:
            self._note(Kind.WRONG, number)
            return
        self._dispatch.answered(number, Name(message.delivered.publisher), number, now_s)
        self._send(now_s)

    def _begin(self, now_s: float) -> None:
        self._count += 1
        call = self._count
        self._note(Kind.CALLED, call)
        try:
            self._dispatch.begin(
                now_s,
                lambda number: _REQUEST.pack(self._token, number),
                self._timeout_s,
                lambda _: self._note(Kind.ANSWERED, call),
                partial(self._failed, call),
            )
        except LocalError:  # no server is there: the caller is notified at once
            self._note(Kind.FAILED, call)

    def _failed(self, call: int, failure: Failure, reason: str) -> None:
        del failure, reason
        self._note(Kind.FAILED, call)

    def _send(self, now_s: float) -> None:
        for effect in self._dispatch.poll_effects():
            if not isinstance(effect, Ask):
                continue  # servers answer at once: there is nothing to stop
            if effect.servers is None:
                self._stream.publish(effect.request)
            for server in effect.servers or ():
                try:
                    self._services.send_request(self._name, server, effect.request)
                except LocalError as error:
                    self._dispatch.refused(effect.call, server, str(error), now_s)

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


class Serving:
    """Server that echoes each request."""

    def __init__(self, station: End, name: Name, token: bytes) -> None:
        self._station, self._name, self._token = station, name, token

    def take(self, message: Message, now_s: float) -> None:
        """Answer a client; a client that has gone meanwhile gets nothing."""
        del now_s
        body = message.delivered.message
        if body[: len(self._token)] == self._token:
            try:
                self._station.member.services.respond(self._name, Name(message.delivered.publisher), body)
            except LocalError as error:
                print(f"not answered: {error}", file=sys.stderr, flush=True)


def main() -> None:
    """Run as a member until ended."""
    settings: dict[str, Any] = json.loads(sys.argv[1])
    out, incarnation_id = RecordWriter(Path(settings["records"])), settings["incarnation_id"]
    tokens = {int(channel): bytes.fromhex(token) for channel, token in settings["tokens"].items()}
    station = End.from_config(Path(settings["config"]), 0.0)
    takers: dict[Name, Reading | Serving | Caller] = {}
    for each in settings["read"]:
        takers[station.subscribe(each["name"])] = Reading(each["channel"], tokens[each["channel"]], out)
    for each in settings["serve"]:
        name = station.serve(each["name"])
        takers[name] = Serving(station, name, tokens[each["channel"]])
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
            for caller in remote_clients:
                caller.go_on(now_s)
            for name, taker in takers.items():
                if isinstance(taker, Reading):
                    taker.look(station, name, now_s)
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
