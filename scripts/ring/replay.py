"""Replay through the ring: reads the reports of both sides until both have finished.

I/O.
"""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from lab.child import Child
from lab.children import Children, cancel
from lab.events import Event
from lab.process import FailedError
from ring.injection import Injection
from ring.progress import ProgressReporter, Traffic
from ring.silence import Silence

ENDING_S: Final = 30.0  # to close a recording, or to get the last acknowledgements
STALL_S: Final = 30.0
_ALL: Final = "recording"  # its topics are counted together

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Report:
    """Final reports of both sides.

    Args:
        topics: the receiver's measurements, one event a topic.
        unread: why some of the recording could not be read; None if all could.
        complaints: deviations from the expected run.
        traffic_s: from the first message until all was confirmed or given up.
        silent_s: the longest time in which messages were due and none came, to half a second.
    """

    topics: tuple[Event, ...]
    unread: str | None
    complaints: tuple[str, ...]
    traffic_s: float
    silent_s: float


class Replay:
    """One replay in progress.

    Args:
        children: supervised throughout; the receiver is released when it is requested to finish.
    """

    def __init__(
        self, children: Children, sender: Child, receiver: Child, total: int, reporter: ProgressReporter
    ) -> None:
        self._children = children
        self._sender = sender
        self._receiver = receiver
        self._reporter = reporter
        self._traffic = Traffic(total=total)
        self._silence = Silence()
        self._unconfirmed = ""  # names of topics
        self._moved = asyncio.Event()

    async def report(self, inject: Callable[[], Injection]) -> Report:
        """Follow the traffic to its end, while ``inject`` causes faults."""
        self._reporter.begin_traffic(self._traffic.total)
        heard = asyncio.ensure_future(self._listen(self._receiver))
        injection, begun_s = inject(), time.monotonic()
        try:
            sent = await self._children.guarded(self._unstalled(self._listen(self._sender)))
            traffic_s = time.monotonic() - begun_s
            sender_code = await self._sender.wait(ENDING_S)
            if sent is None:
                raise self._sender.failed(f"ended with code {sender_code} in the middle")
            received, receiver_code = await self._finish(heard)
        finally:
            await cancel(heard)
            await injection.stop()
            self._reporter.end_traffic()
        complaints = injection.complaints()
        complaints += [_not_confirmed(topic) for topic in sent.parts("unconfirmed")]
        complaints += [f"the sender ended with code {sender_code}"] if sender_code else []
        complaints += [f"the receiver ended with code {receiver_code}"] if receiver_code else []
        unread = sent.text_or_none("unread") or None
        topics = tuple(received.parts("topics"))
        return Report(topics, unread, tuple(complaints), traffic_s, self._silence.longest_s)

    async def _finish(self, heard: asyncio.Future[Event | None]) -> tuple[Event, int]:
        """Request the receiver to close its recording; return its last event and its exit code."""
        self._children.may_end(self._receiver)
        self._receiver.send(signal.SIGINT)
        try:
            received = await self._children.guarded(asyncio.wait_for(heard, ENDING_S))
        except asyncio.TimeoutError:
            raise self._receiver.failed(f"did not finish within {ENDING_S:g} s") from None
        code = await self._receiver.wait(ENDING_S)
        if received is None:
            raise self._receiver.failed(f"ended with code {code} without a report")
        return received, code

    async def _listen(self, child: Child) -> Event | None:
        """Follow a child until it closes its output; return its last event, None if there was none."""
        done = None
        async for event in child.events():
            if event.name == "progress":
                self._follow(event)
            elif event.name == "done":
                done = event
        return done

    def _follow(self, event: Event) -> None:
        before, now_s = self._traffic, time.monotonic()
        if "sent" in event.fields:
            self._silence.sent(_ALL, event.count("sent"), now_s)
            self._unconfirmed = ", ".join(event.part("unconfirmed").fields)
            self._traffic = replace(before, sent=event.count("sent"))
            waiting = before.sent < before.total  # for the next stamp of the recording, which may have long pauses
        else:
            received, lost = event.count("received"), event.count("lost")
            latency_ms = event.number_or_none("latency_ms")
            self._silence.received(_ALL, received + lost, now_s)
            self._traffic = replace(before, received=received, lost=lost, latency_ms=latency_ms)
            waiting = False
        if waiting or self._traffic != before:
            self._moved.set()
        silent = tuple((self._unconfirmed or flow, seconds) for flow, seconds in self._silence.silent(now_s))
        self._reporter.traffic(replace(self._traffic, behind=self._silence.behind, silent=silent))

    async def _unstalled(self, work: Coroutine[None, None, T]) -> T:
        """Run ``work`` as long as traffic moves."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                self._moved.clear()
                moved = asyncio.ensure_future(self._moved.wait())
                done, _ = await asyncio.wait([task, moved], timeout=STALL_S, return_when=asyncio.FIRST_COMPLETED)
                await cancel(moved)
                if not done:
                    raise FailedError(f"nothing moved for {STALL_S:g} s: {self._traffic.words(0.0)}")
            return task.result()
        finally:
            await cancel(task)


def _not_confirmed(topic: Event) -> str:
    messages, confirmed = topic.count("messages"), topic.count("confirmed")
    return f"{topic.text('topic')}: {messages - confirmed} of {messages} were never confirmed"
