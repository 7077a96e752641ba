"""Exchange of one end: publishes its streams at their times, and keeps the ages of what arrives.

I/O: reads a clock and sleeps; a thread for each stream, so a publisher that waits delays no other.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, Protocol

from thin_link.traffic import Direction, Stream, make_message, open_message

_QUEUE: Final = 1_024

Arrival = Callable[[Stream, bytes, int], None]  # stream, message, monotonic ns; any thread


class Carrier(Protocol):
    """One end of a system."""

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        """Publish a stream; return what sends a message, which may wait."""

    def subscribe(self, stream: Stream) -> None:
        """Read a stream from now on."""

    def is_matched(self) -> bool:
        """Return whether every published stream is read."""


@dataclass(frozen=True, slots=True)
class Window:
    """Monotonic nanoseconds between which streams begin, are measured, and end."""

    start_ns: int
    begin_ns: int
    end_ns: int

    def has(self, due_ns: int) -> bool:
        """Return whether a message that was due then is measured."""
        return self.begin_ns <= due_ns < self.end_ns


@dataclass(slots=True)
class Tally:
    """One stream at one end.

    Attributes:
        due: messages of the window that were due.
        sent: of those, messages that the system took in time; a publisher that waits misses the others.
        ages_s: of the whole messages that were due in the window and arrived.
        whole: whole messages that arrived in the window, whenever they were due.
        broken, doubled: messages that were not whole, or arrived again.
    """

    due: int = 0
    sent: int = 0
    ages_s: list[float] = field(default_factory=list)
    whole: int = 0
    broken: int = 0
    doubled: int = 0


class Exchange:
    """One end of the traffic. ``direction``: of the streams that this end publishes."""

    def __init__(self, mix: Iterable[Stream], direction: Direction) -> None:
        self._mix = tuple(mix)
        self._direction = direction
        self._window: Window | None = None
        self.tallies = {each.name: Tally() for each in self._mix}
        self._arrived = set[tuple[str, int]]()  # stream, number
        self._requests = {each.answers: queue.Queue[tuple[int, int]](_QUEUE) for each in self._mix if each.answers}
        self.refusals: list[str] = []
        self._senders: dict[str, Callable[[bytes], None]] = {}

    def join(self, carrier: Carrier) -> None:
        """Publish the streams of this end, and read the others."""
        for each in self._mix:
            if each.direction == self._direction:
                self._senders[each.name] = carrier.publish(each)
            else:
                carrier.subscribe(each)

    def start(self, window: Window) -> None:
        """Publish from now on, until the window ends."""
        self._window = window
        for each in self._mix:
            if each.direction != self._direction:
                continue
            work, sender = self._publish if each.period_s else self._answer, self._senders[each.name]
            threading.Thread(target=work, args=(each, sender, window), name=f"publish {each.name}", daemon=True).start()

    def take(self, stream: Stream, message: bytes, now_ns: int) -> None:
        """Take a message that arrived."""
        window, tally = self._window, self.tallies[stream.name]
        if window is None:
            return
        opened = open_message(message, stream.size)
        if opened is None:
            tally.broken += 1
            return
        number, due_ns = opened
        tally.whole += window.has(now_ns)
        if window.has(due_ns):
            if (stream.name, number) in self._arrived:
                tally.doubled += 1
            else:
                self._arrived.add((stream.name, number))
                tally.ages_s.append((now_ns - due_ns) / 1e9)
        if stream.name in self._requests:
            try:
                self._requests[stream.name].put_nowait(opened)
            except queue.Full:
                self.refusals.append(f"{stream.name}: too many requests wait")

    def _publish(self, stream: Stream, send: Callable[[bytes], None], window: Window) -> None:
        """Publish at each due moment; one that passes while the system makes the publisher wait is missed."""
        body, tally, period_ns = os.urandom(stream.size), self.tallies[stream.name], round(stream.period_s * 1e9)
        number, due_ns = 0, window.start_ns
        while due_ns < window.end_ns:
            time.sleep(max(due_ns - time.monotonic_ns(), 0) / 1e9)
            is_measured = window.has(due_ns)
            tally.due += is_measured
            if time.monotonic_ns() < due_ns + period_ns:
                self._send(stream, send, make_message(number, due_ns, body))
                tally.sent += is_measured
            number, due_ns = number + 1, due_ns + period_ns

    def _answer(self, stream: Stream, send: Callable[[bytes], None], window: Window) -> None:
        """Answer each request; the age of an answer counts from when its request was due."""
        body, waiting, tally = os.urandom(stream.size), self._requests[stream.answers], self.tallies[stream.name]
        while True:
            number, due_ns = waiting.get()
            self._send(stream, send, make_message(number, due_ns, body))
            tally.sent += window.has(due_ns)

    def _send(self, stream: Stream, send: Callable[[bytes], None], message: bytes) -> None:
        try:
            send(message)
        except Exception as error:  # each system has errors of its own, and none may end the other streams
            self.refusals.append(f"{stream.name}: {error}")
