"""Roles of a live ring: talkers, listeners, the server and the caller, for either ROS.

I/O. No role ends by itself: latched messages must stay available, and a kept ring continues.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn, TypeAlias

from proxy.bridge.core.topic_stats import percentile
from ring.nodes.content import LAMP, LAMP_HZ, LAMP_TYPE, Mark, Talk, digest, lamp_says
from ring.nodes.node import Call, Order, Orders, load_type, say

if TYPE_CHECKING:
    from ring.nodes.ros1 import Ros1Node
    from ring.nodes.ros2 import Ros2Node

Node: TypeAlias = "Ros1Node | Ros2Node"

_GREETING_S: Final = 0.2
_LOOK_S: Final = 0.25
_CALL_S: Final = 8.0  # longer than the proxies' timeout for a client


class _Pace:
    """Steps at an even rate."""

    def __init__(self, hz: float, orders: Orders) -> None:
        self._period_s = 1 / hz
        self._orders = orders
        self._next_s = time.monotonic()
        self._tell_at_s = self._next_s

    def step(self, **progress: object) -> None:
        """Wait for the next step; twice a second, report the progress, if any is given."""
        self._next_s += self._period_s
        self._orders.wait_until(self._next_s)
        if progress and time.monotonic() >= self._tell_at_s:
            self._tell_at_s = time.monotonic() + 0.5
            say("progress", **progress)


def talk(node: Node, orders: Orders, of: Talk, count: int) -> NoReturn:
    """Send greetings until GO, publish ``count`` messages, report, and continue after another GO."""
    send = node.publisher(of.topic, of.type_name, latched=of.latched)
    make = load_type(of.type_name)
    size = 0
    sent = list[str]()

    def publish(number: int) -> object:
        message = make()
        of.fill(message, number, time.time_ns(), node.fit)
        send(message)
        return message

    def publish_counted(number: int) -> None:
        nonlocal size
        message = publish(number)
        size += node.size(message)
        sent.append(digest(message))

    say("ready")
    if of.latched:
        publish_counted(1)  # for late joiners
    while orders.wait(_GREETING_S) is not Order.GO:
        if not of.latched:
            publish(0)
    pace = _Pace(of.hz, orders)
    for number in range(len(sent) + 1, count + 1):
        pace.step(topic=of.topic, sent=len(sent))
        publish_counted(number)
    say("done", topic=of.topic, type=of.type_name, bytes=size, sent=sent)
    orders.wait_for(Order.GO)
    while True:
        count += 1
        orders.wait(1 / of.hz)
        publish(count)


class _Arrivals:
    """Latencies of messages or answers, and the longest time between two of them."""

    def __init__(self) -> None:
        self.latencies_ms: list[float] = []
        self._newest_ns: int | None = None
        self._silent_ms: float | None = None

    def note(self, now_ns: int, latency_ms: float | None) -> None:
        """Add one; ``latency_ms``: None: it is not timed."""
        if self._newest_ns is not None:
            self._silent_ms = max(self._silent_ms or 0.0, (now_ns - self._newest_ns) / 1e6)
        self._newest_ns = now_ns
        if latency_ms is not None:
            self.latencies_ms.append(latency_ms)

    def report(self) -> dict[str, object]:
        """Return its part of a report."""
        ordered = sorted(self.latencies_ms)
        latency = {name: percentile(ordered, at) for name, at in (("median", 0.5), ("p99", 0.99), ("max", 1))}
        return {"latency_ms": latency, "silent_ms": self._silent_ms}


class _Ear:
    """Messages of one topic. The first one is not timed: it may have waited for the subscription."""

    def __init__(self, of: Talk) -> None:
        self._of = of
        self.is_awake = False
        self.heard: list[str] = []
        self.arrivals = _Arrivals()

    def take(self, message: object) -> None:
        now_ns = time.time_ns()
        mark: Mark = self._of.read(message)
        if mark.number:
            self.heard.append(digest(message))
            self.arrivals.note(now_ns, (now_ns - mark.stamp_ns) / 1e6 if self.is_awake else None)
        self.is_awake = True

    def progress(self) -> dict[str, object]:
        return {"topic": self._of.topic, "received": len(self.heard)}

    def report(self) -> dict[str, object]:
        what = {"topic": self._of.topic, "type": self._of.type_name}
        return {**what, "heard": list(self.heard), **self.arrivals.report()}


def listen(node: Node, orders: Orders, talks: Sequence[Talk]) -> NoReturn:
    """Receive all topics; report the first message of each, the counts, and at the end the content."""
    ears = [_Ear(of) for of in talks]
    for of, ear in zip(talks, ears, strict=True):
        node.subscribe(of.topic, of.type_name, ear.take, latched=of.latched)
    say("ready")
    _until(lambda: all(ear.is_awake for ear in ears), orders)
    say("hears")
    while orders.wait(_LOOK_S) is not Order.REPORT:
        latest = [ear.arrivals.latencies_ms[-1] for ear in ears if ear.arrivals.latencies_ms]
        mean = sum(latest) / len(latest) if latest else None
        say("progress", topics=[ear.progress() for ear in ears], latency_ms=mean)
    say("done", topics=[ear.report() for ear in ears])
    orders.wait_for_the_end()


def serve(node: Node, orders: Orders) -> NoReturn:
    """Serve the lamp; report how often it was switched."""
    switched = 0

    def lamp(on: bool) -> tuple[bool, str]:
        nonlocal switched
        switched += 1
        return True, lamp_says(switched, on=on)

    node.serve(LAMP, LAMP_TYPE, lamp)
    say("ready")
    orders.wait_for(Order.REPORT)
    say("done", served=switched)
    orders.wait_for_the_end()


def call(node: Node, orders: Orders, count: int) -> NoReturn:
    """Call the lamp ``count`` times at a steady pace, one call after the other; report the correct replies."""
    client = node.caller(LAMP, LAMP_TYPE)
    say("ready")
    _until(lambda: client.wait(_LOOK_S), orders)
    say("hears")
    orders.wait_for(Order.GO)
    pace = _Pace(LAMP_HZ, orders)
    size = right = newest = 0
    arrivals = _Arrivals()
    give_up_s = time.monotonic() + count / LAMP_HZ + _CALL_S
    for number in range(1, count + 1):
        pace.step()
        if time.monotonic() > give_up_s:
            break  # failing calls take long
        say("progress", asked=number, answered=len(arrivals.latencies_ms))
        on = bool(number % 2)
        began_ns = time.perf_counter_ns()
        answer = client.call(on=on, patience_s=_CALL_S)
        if answer is not None:
            now_ns = time.perf_counter_ns()
            arrivals.note(now_ns, (now_ns - began_ns) / 1e6)
            size += answer.size
            at = _switched(answer, on=on)
            right += at > newest
            newest = max(newest, at)
    answered = len(arrivals.latencies_ms)
    say("progress", asked=count, answered=answered)
    say("done", calls=count, bytes=size, answered=answered, right=right, **arrivals.report())
    orders.wait_for(Order.GO)
    while True:
        orders.wait(1 / LAMP_HZ)
        count += 1
        client.call(on=bool(count % 2), patience_s=_CALL_S)


def _switched(answer: Call, *, on: bool) -> int:
    """Return how often the lamp was switched, from a correct reply; 0: an incorrect one."""
    words = answer.message.split()
    number = int(words[2]) if len(words) == 4 and words[2].isdigit() else 0
    return number if answer.success and answer.message == lamp_says(number, on=on) else 0


def _until(is_so: Callable[[], bool], orders: Orders) -> None:
    while not is_so():
        orders.wait(_LOOK_S)
