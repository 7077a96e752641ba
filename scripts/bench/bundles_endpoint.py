"""Endpoint process of the bundle bench: a member that publishes small messages on many topics, or reads them.

Process of its own, started by ``bundles.py``. A message is 100 bytes and carries the moment at which it was due
(``CLOCK_MONOTONIC``, one clock for all namespaces of a machine). At a steady rate a kernel timer makes them due, topic
after topic. In overload a message is due whenever its topic has fewer than ``BACKLOG`` unconfirmed ones.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Mapping
from itertools import cycle, islice
from typing import Any, Final

from member_endpoint import PATIENCE_S, End, Timer, run_role
from peers.jsonl import say
from report import percentile

from gdp.client.publisher import Publisher
from gdp.nodes.memory_tuning import tune_memory

__all__ = ["BACKLOG", "MESSAGE_BYTES", "topics"]

BACKLOG: Final = 2_000  # unconfirmed messages a topic, in overload
MESSAGE_BYTES: Final = 100
_MESSAGE: Final = struct.Struct("!Bq91x")  # kind of message, due time in ns
_WARM_UP, _MEASURED, _LAST = range(3)
_WARM_UP_S: Final = 0.5
_AT_ONCE: Final = 400  # messages published between two polls of the network, in overload
_TICK_S: Final = 0.001

Settings = Mapping[str, Any]


def topics(count: int) -> list[str]:
    """Return the names of the topics."""
    return [f"/small{at}" for at in range(count)]


class _Sender:
    """Publishes on all topics in turn."""

    def __init__(self, end: End, publishers: list[Publisher], seconds: float) -> None:
        self._end = end
        self.publishers = publishers
        self._turns = cycle(publishers)
        self._measured_ns = time.monotonic_ns() + round(_WARM_UP_S * 1e9)
        self.end_ns = self._measured_ns + round(seconds * 1e9)
        self.sent = 0
        self._cpu_s = 0.0

    def publish(self, publisher: Publisher, due_ns: int) -> None:
        """Publish one message."""
        what = _WARM_UP if due_ns < self._measured_ns else _MEASURED
        if what == _MEASURED:
            self._cpu_s = self._cpu_s or time.process_time()
            self.sent += 1
        publisher.publish(_MESSAGE.pack(what, due_ns))

    def at_rate(self, rate: float) -> None:
        """Publish at this rate, in messages a second, until the end."""
        gap_ns, due_ns = 1e9 / rate, float(time.monotonic_ns())
        timer = Timer(time.monotonic_ns(), _TICK_S)

        def tick() -> None:
            nonlocal due_ns
            timer.passed()
            now_ns = time.monotonic_ns()
            while due_ns <= now_ns and due_ns < self.end_ns:
                self.publish(next(self._turns), round(due_ns))
                due_ns += gap_ns
            self._end.member.flush(time.monotonic())

        self._end.plane.watch(timer, tick)
        self._end.runtime.run(lambda: due_ns >= self.end_ns)
        self._end.plane.unwatch(timer)
        timer.close()

    def in_overload(self) -> None:
        """Publish until the end as fast as messages are confirmed."""
        while (now_ns := time.monotonic_ns()) < self.end_ns:
            free = {each: BACKLOG - each.messages + each.acknowledged for each in self.publishers}
            for publisher in islice(self._turns, _AT_ONCE):
                if free[publisher] > 0:
                    free[publisher] -= 1
                    self.publish(publisher, now_ns)
            self._end.member.flush(time.monotonic())
            self._end.runtime.step(time.monotonic() if max(free.values()) > 0 else time.monotonic() + 1.0)

    def finish(self) -> None:
        """Announce the end, wait for the confirmation, and report."""
        cpu_s = time.process_time() - self._cpu_s
        for publisher in self.publishers:
            publisher.publish(_MESSAGE.pack(_LAST, time.monotonic_ns()))
        self._end.member.flush(time.monotonic())
        latest_s = time.monotonic() + PATIENCE_S
        if not self._end.runtime.run(lambda: all(each.is_acknowledged() for each in self.publishers), latest_s):
            raise TimeoutError("messages were not confirmed")
        repaired = sum(each.repairs for each in self.publishers)
        say(sent=self.sent, cpu_s=cpu_s, repaired=repaired, drops=self._end.drops())


def send(end: End, settings: Settings) -> None:
    """Run as A."""
    publishers = [end.advertise(topic, reliable=True) for topic in topics(int(settings["topics"]))]
    if not settings["bundles"]:
        for publisher in publishers:
            publisher.bundle_bytes = 0
    tune_memory()
    end.wait_for_readers(publishers)
    sender = _Sender(end, publishers, float(settings["seconds"]))
    if rate := float(settings["rate"]):
        sender.at_rate(rate)
    else:
        sender.in_overload()
    sender.finish()
    end.leave()


def read(end: End, settings: Settings) -> None:
    """Run as B: read all, and report when every topic's last message has arrived."""
    names = {end.subscribe(topic): topic for topic in topics(int(settings["topics"]))}
    latencies_s: list[float] = []
    seals: set[tuple[bytes, int]] = set()
    begun_s = cpu_s = 0.0
    open_topics = set(names)
    with end.runtime.signals():
        say(event="ready")
        while open_topics and not end.runtime.is_stopped:
            end.runtime.step(time.monotonic() + PATIENCE_S)
            now_ns = time.monotonic_ns()
            for each in end.member.poll_messages():
                what, due_ns = _MESSAGE.unpack(each.delivered.message)
                if what == _LAST:
                    open_topics.discard(each.topic)
                elif what == _MEASURED:
                    begun_s, cpu_s = begun_s or now_ns / 1e9, cpu_s or time.process_time()
                    latencies_s.append((now_ns - due_ns) / 1e9)
                    seals.add((each.topic, each.delivered.number))
        took_s, cpu_s = time.monotonic() - begun_s, time.process_time() - cpu_s
        say(
            got=len(latencies_s),
            took_s=took_s,
            cpu_s=cpu_s,
            seals=len(seals),
            p50_s=percentile(latencies_s, 0.5),
            p99_s=percentile(latencies_s, 0.99),
            lost=sum(feed.lost for feed in end.member.writer_proxies()),
            drops=end.drops(),
        )
        while not end.runtime.is_stopped:  # the last confirmations
            end.runtime.step(time.monotonic() + PATIENCE_S)


if __name__ == "__main__":
    run_role({"send": send, "read": read})
