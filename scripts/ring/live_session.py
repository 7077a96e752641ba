"""Session of live traffic: reads the reports of all nodes until no message is under way.

I/O.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import time
from collections.abc import Awaitable, Mapping
from dataclasses import dataclass
from typing import Final

from lab.child import Child
from lab.children import Children, cancel, gathered
from lab.events import Event
from ring.live_result import Heard
from ring.nodes.content import LAMP
from ring.progress import ProgressReporter, Traffic
from ring.silence import Silence

MEET_S: Final = 60.0
ENDING_S: Final = 30.0
QUIET_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class LiveNodes:
    """The nodes of a live run, all ready. ``talkers``: number of messages that each will publish."""

    talkers: Mapping[Child, int]
    lamp: Child
    listener: Child
    caller: Child
    calls: int

    @property
    def messages(self) -> int:
        """Return the total number of messages to be published."""
        return sum(self.talkers.values())


class LiveSession:
    """One run's traffic. ``children`` owns the nodes."""

    def __init__(self, children: Children, live_nodes: LiveNodes, reporter: ProgressReporter) -> None:
        self._children = children
        self._live_nodes = live_nodes
        self._reporter = reporter
        self._sent: dict[Child, int] = {}
        self._received: dict[str, int] = {}
        self._asked = 0
        self._answered = 0
        self.silence = Silence()
        self._latency_ms: float | None = None
        self._moved = asyncio.Event()

    async def meet(self) -> None:
        """Wait until the remote side receives every topic and discovers the service."""
        far = (self._live_nodes.listener, self._live_nodes.caller)
        await self._children.guarded(gathered(child.wait_for("hears", MEET_S) for child in far))

    async def talk(self, seconds: float) -> Heard:
        """Run the traffic for this long, wait for messages under way, and return each node's report."""
        live_nodes = self._live_nodes
        self._reporter.begin_traffic(live_nodes.messages + live_nodes.calls)
        ear = asyncio.ensure_future(self._follow(live_nodes.listener))
        lamp = asyncio.ensure_future(self._follow(live_nodes.lamp))
        try:
            for child in (*live_nodes.talkers, live_nodes.caller):
                child.send(signal.SIGUSR1)
            patience_s = seconds + ENDING_S
            speaking = [
                _in_time(child, self._follow(child), patience_s) for child in (*live_nodes.talkers, live_nodes.caller)
            ]
            *talkers, caller = await self._children.guarded(gathered(speaking))
            self._answered = caller.count("answered")
            await self._children.guarded(self._until_quiet())
            live_nodes.listener.send(signal.SIGINT)
            live_nodes.lamp.send(signal.SIGINT)
            nodes = ((live_nodes.listener, ear), (live_nodes.lamp, lamp))
            ending = gathered(_in_time(node, report, ENDING_S) for node, report in nodes)
            listener_said, lamp_said = await self._children.guarded(ending)
        finally:
            await cancel(ear, lamp)
            self._reporter.end_traffic()
        return Heard(tuple(talkers), lamp_said, listener_said, caller)

    async def _follow(self, child: Child) -> Event:
        """Follow a node until its report."""
        async with contextlib.aclosing(child.events()) as events:
            async for event in events:
                if event.name == "done":
                    return event
                if event.name == "progress":
                    self._note(child, event)
        raise child.failed(f"ended with code {await child.ended} before its report")

    def _note(self, child: Child, event: Event) -> None:
        now_s, silence = time.monotonic(), self.silence
        if child is self._live_nodes.listener:
            received = {each.text("topic"): each.count("received") for each in event.parts("topics")}
            if received != self._received:
                self._moved.set()
            for topic, count in received.items():
                silence.received(topic, count, now_s)
            self._received = received
            self._latency_ms = event.number_or_none("latency_ms")
        elif child is self._live_nodes.caller:
            self._asked, self._answered = event.count("asked"), event.count("answered")
            silence.sent(LAMP, self._asked, now_s)
            silence.received(LAMP, self._answered, now_s)
        else:
            self._sent[child] = event.count("sent")
            silence.sent(event.text("topic"), event.count("sent"), now_s)
        self._reporter.traffic(
            Traffic(
                total=self._live_nodes.messages + self._live_nodes.calls,
                sent=sum(self._sent.values()) + self._asked,
                received=sum(self._received.values()) + self._answered,
                behind=silence.behind,
                silent=tuple(silence.silent(now_s)),
                latency_ms=self._latency_ms,
            )
        )

    async def _until_quiet(self) -> None:
        """Wait until everything arrived, or nothing arrived for a while."""
        while sum(self._received.values()) < self._live_nodes.messages:
            self._moved.clear()
            try:
                await asyncio.wait_for(self._moved.wait(), QUIET_S)
            except asyncio.TimeoutError:
                return


async def _in_time(child: Child, report: Awaitable[Event], patience_s: float) -> Event:
    try:
        return await asyncio.wait_for(report, patience_s)
    except asyncio.TimeoutError:
        raise child.failed(f"did not report within {patience_s:g} s") from None
