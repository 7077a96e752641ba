"""Member at the end of a network under test: publishes, reads, serves, calls, and records all of it.

Process of its own, started by ``faults.overlay`` with one argument of JSON. Each arrival is appended to a file of
records at once, so that nothing is lost when this process is killed. A message names its channel, its publisher and
the publisher's incarnation, so a message at a wrong reader is detected.
"""

from __future__ import annotations

import json
import math
import random
import signal
import struct
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, BinaryIO, Final

from peers.jsonl import say

from faults.records import Kind, Record
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


class Part:
    """What a member does on one channel: ``settings`` are a flow or service, with its token."""

    def __init__(self, end: End, settings: dict[str, Any], member: tuple[int, int], out: BinaryIO) -> None:
        self.channel: int = settings["channel"]
        self.token = bytes.fromhex(settings["token"])
        self.index, self.incarnation_id = member
        self.due_s = math.inf
        self._out = out
        self.topic = end.topics[settings.get("topic") or settings["name"]]

    def go_on(self, now_s: float) -> None:
        """Do what is due."""

    def take(self, message: Message, now_s: float) -> None:
        """Take a message of the channel."""

    def note(self, kind: Kind, number: int, other: int = 0, incarnation_id: int | None = None) -> None:
        """Record something now."""
        incarnation_id = self.incarnation_id if incarnation_id is None else incarnation_id
        self._out.write(Record(kind, self.channel, incarnation_id, other, number, time.monotonic_ns()).to_bytes())


class Source(Part):
    """Publishes one topic at an even rate."""

    def __init__(self, end: End, settings: dict[str, Any], member: tuple[int, int], out: BinaryIO) -> None:
        super().__init__(end, settings, member, out)
        self._publisher = end.advertise(settings["topic"], reliable=settings["reliable"])
        self._filler = bytes(max(settings["size"] - _HEAD.size, 0))
        self._every_s = 1.0 / float(settings["hz"])
        self.due_s = time.monotonic() + random.random() * self._every_s
        self._number = 0

    def go_on(self, now_s: float) -> None:
        """Publish all messages that are due."""
        if now_s - self.due_s > _BEHIND_S:
            self.due_s = now_s
        while self.due_s <= now_s:
            self._number += 1
            self.note(Kind.PUBLISHED, self._number, self.index)
            head = _HEAD.pack(self.token, self.channel, self.index, self.incarnation_id, self._number)
            self._publisher.publish(head + self._filler)
            self.due_s += self._every_s


class Reading(Part):
    """Messages received on one topic."""

    def __init__(self, end: End, settings: dict[str, Any], member: tuple[int, int], out: BinaryIO) -> None:
        super().__init__(end, settings, member, out)
        self._subscriptions = end.member.subscriptions
        end.subscribe(settings["topic"])
        self._counts = Counter[LossReason]()
        self.due_s = 0.0

    def go_on(self, now_s: float) -> None:
        """Record reported losses, at intervals."""
        if now_s >= self.due_s:
            self.due_s = now_s + _LOOK_S
            counts = Counter(self._subscriptions.losses_of(self.topic.name).counts)
            for reason, number in (counts - self._counts).items():
                self.note(Kind.LOST, number, reason, 0)
            self._counts = counts

    def take(self, message: Message, now_s: float) -> None:
        """Record a message; one of another channel counts as wrong."""
        del now_s
        token, channel, publisher, incarnation_id, number = _HEAD.unpack_from(message.delivered.message)
        if token != self.token or channel != self.channel:
            self.note(Kind.WRONG, number, channel, 0)
        else:
            self.note(Kind.DELIVERED, number, publisher, incarnation_id)


class Caller(Part):
    """Caller of one service at an even rate: all replicas receive the request, the first response counts."""

    def __init__(self, end: End, settings: dict[str, Any], member: tuple[int, int], out: BinaryIO) -> None:
        super().__init__(end, settings, member, out)
        self._client = ClientCore(end.member, self.topic, settings["name"], start=random.getrandbits(62))
        self._timeout_s, self._every_s = float(settings["timeout_s"]), 1.0 / float(settings["hz"])
        self._next_s = self.due_s = time.monotonic() + random.random() * self._every_s
        self._count = 0
        self._under_way: dict[int, Call] = {}

    def go_on(self, now_s: float) -> None:
        """Make the calls that are due, and record those that have ended."""
        timer_s = self._client.get_timer()
        if timer_s is not None and now_s >= timer_s:
            self._client.handle_timer(now_s)
        if now_s >= self._next_s:
            self._next_s = max(self._next_s + self._every_s, now_s - _BEHIND_S)
            self._count += 1
            request = _REQUEST.pack(self.token, self._count)
            call = self._under_way[self._count] = Call(payload=request, timeout_s=self._timeout_s, replication=ALL)
            self.note(Kind.CALLED, self._count)
            self._client.begin(call, now_s)
        for number, call in list(self._under_way.items()):
            if call.is_done:
                del self._under_way[number]
                self.note(Kind.FAILED if call.response is None else Kind.ANSWERED, number)
                if call.response is not None and call.response.payload != call.payload:
                    self.note(Kind.WRONG, number)
        self.due_s = min(self._next_s, self._client.get_timer() or math.inf)

    def take(self, message: Message, now_s: float) -> None:
        """Handle a server's response."""
        self._client.receive(message, now_s)


class Server(Part):
    """Server that echoes each request of its channel."""

    def __init__(self, end: End, settings: dict[str, Any], member: tuple[int, int], out: BinaryIO) -> None:
        super().__init__(end, settings, member, out)
        self._core = ServerCore(end.member, self.topic, start=random.getrandbits(62), at_once=None)

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
            is_ours = turn.request.startswith(self.token)
            self._core.finish(turn.number, turn.request if is_ours else "a request of another channel", now_s)


def part_of(member: str, settings: dict[str, Any]) -> type[Part]:
    """Return what a member does for a flow or service."""
    if "servers" in settings:
        return Server if member in settings["servers"] else Caller
    return Source if member == settings["publisher"] else Reading


def run(settings: dict[str, Any], out: BinaryIO) -> None:
    """Run as a member until ended."""
    end = End.from_config(Path(settings["config"]), 0.0)
    parts: dict[Name, Part] = {}

    def begin(each: dict[str, Any]) -> None:
        kind = part_of(settings["member"], each)
        part = kind(end, each, (settings["index"], settings["incarnation_id"]), out)
        parts[part.topic.name] = part

    waiting = iter([each for each in settings["channels"] if each.get("waits")])
    for each in settings["channels"]:
        if not each.get("waits"):
            begin(each)
    signal.signal(signal.SIGUSR1, lambda *_: begin(next(waiting)))
    tune_memory()
    with end.runtime.signals():
        say(event="ready")
        while not end.runtime.is_stopped:
            now_s = time.monotonic()
            for part in list(parts.values()):
                part.go_on(now_s)
            end.member.flush(now_s)
            out.flush()
            end.runtime.step(min([now_s + _LOOK_S, *(part.due_s for part in parts.values())]))
            now_s = time.monotonic()
            for message in end.member.poll_messages():
                parts[message.topic].take(message, now_s)
        end.leave()


if __name__ == "__main__":
    given: dict[str, Any] = json.loads(sys.argv[1])
    with Path(given["records"]).open("ab") as records:
        run(given, records)
