"""The time between the first message and the last: both ends are listened to until both have finished.

Place: shell.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from gdp.testbed.namespaces import Namespaces
from proxy.ring.child import Child, ChildError
from proxy.ring.children import Children, cancel
from proxy.ring.cutting import Cutting
from proxy.ring.events import Event
from proxy.ring.options import Cut
from proxy.ring.progress import Teller, Traffic

__all__ = ["Replay", "Report"]

ENDING_S: Final = 30.0  # to close a recording, or to get the last acknowledgements
STALL_S: Final = 30.0

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Report:
    """What the ends said last.

    Args:
        topics: the receiver's measurements, one event a topic.
        unread: why some of the recording could not be read; None if all could.
        complaints: what went otherwise than wanted.
    """

    topics: tuple[Event, ...]
    unread: str | None
    complaints: tuple[str, ...]


class Replay:
    """One replay under way.

    Args:
        children: watched all the while; the receiver among them is let go when it is asked to finish.
        sender: has said that it is ready.
        receiver: likewise.
        total: messages expected.
        teller: hears of the traffic.
    """

    def __init__(self, children: Children, sender: Child, receiver: Child, total: int, teller: Teller) -> None:
        self._children = children
        self._sender = sender
        self._receiver = receiver
        self._teller = teller
        self._traffic = Traffic(total)
        self._moved = asyncio.Event()

    async def report(self, namespaces: Namespaces, cuts: tuple[Cut, ...]) -> Report:
        """Follow the traffic to its end, cutting links on the way.

        Raises:
            ChildError: a process failed, nothing moved for long, or an end did not finish.
            LocalError: a link cannot be cut.
        """
        self._teller.begin_traffic(self._traffic.total)
        heard = asyncio.ensure_future(self._listen(self._receiver))
        cutting = Cutting(namespaces, cuts, self._teller)
        try:
            sent = await self._children.guarded(self._unstalled(self._listen(self._sender)))
            sender_code = await self._sender.wait(ENDING_S)
            if sent is None:
                raise self._sender.failed(f"ended with code {sender_code} in the middle")
            received, receiver_code = await self._finish(heard)
        finally:
            await cancel(heard)
            await cutting.stop()
            self._teller.end_traffic()
        complaints = cutting.complaints()
        complaints += [f"the sender ended with code {sender_code}"] if sender_code else []
        complaints += [f"the receiver ended with code {receiver_code}"] if receiver_code else []
        return Report(tuple(received.parts("topics")), sent.text_or_none("unread") or None, tuple(complaints))

    async def _finish(self, heard: asyncio.Future[Event | None]) -> tuple[Event, int]:
        """Ask the receiver to close its recording; return its last word and its exit code."""
        self._children.may_end(self._receiver)
        self._receiver.interrupt()
        try:
            received = await self._children.guarded(asyncio.wait_for(heard, ENDING_S))
        except asyncio.TimeoutError:
            raise self._receiver.failed(f"did not finish within {ENDING_S:g} s") from None
        code = await self._receiver.wait(ENDING_S)
        if received is None:
            raise self._receiver.failed(f"ended with code {code} without a report")
        return received, code

    async def _listen(self, child: Child) -> Event | None:
        """Follow a child until it closes its output; return its last word, None if it did not say it."""
        done = None
        async for event in child.events():
            if event.name == "progress":
                self._follow(event)
            elif event.name == "done":
                done = event
        return done

    def _follow(self, event: Event) -> None:
        before = self._traffic
        if "sent" in event.fields:
            self._traffic = replace(before, sent=event.count("sent"))
            waiting = before.sent < before.total  # for a moment of the recording, which may be silent for long
        else:
            received, lost = event.count("received"), event.count("lost")
            latency_ms = event.number_or_none("latency_ms")
            self._traffic = replace(before, received=received, lost=lost, latency_ms=latency_ms)
            waiting = False
        if waiting or self._traffic != before:
            self._moved.set()
        self._teller.traffic(self._traffic)

    async def _unstalled(self, work: Coroutine[None, None, T]) -> T:
        """Do ``work`` as long as traffic moves."""
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                self._moved.clear()
                moved = asyncio.ensure_future(self._moved.wait())
                done, _ = await asyncio.wait([task, moved], timeout=STALL_S, return_when=asyncio.FIRST_COMPLETED)
                await cancel(moved)
                if not done:
                    raise ChildError(f"nothing moved for {STALL_S:g} s: {self._traffic.words(0.0)}")
            return task.result()
        finally:
            await cancel(task)
