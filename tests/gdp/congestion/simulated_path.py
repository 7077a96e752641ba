"""Flows on one simulated bottleneck in virtual time: the controller under test, CUBIC, and an acknowledging reader.

The bottleneck is the channel of the uplink bench. A frame that is overtaken by an acknowledgement is lost, because a
FIFO keeps its order; a silence of several round trips loses all that is under way.
"""

from __future__ import annotations

import heapq
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Protocol

sys.path.append(str(Path(__file__).resolve().parents[3] / "scripts" / "bench"))

from thin_link.channel import Channel, ConstantRate, Loss

from gdp.congestion.controller import PathController
from gdp.congestion.cubic import Cubic
from gdp.congestion.delivery_rate import DeliveryRate, Flight

MTU = 1_500
_SILENCE_S = 1.0


class Sender(Protocol):
    """Decides when a flow sends."""

    def next_send_s(self, size: int) -> float | None: ...

    def sent(self, size: int, now_s: float) -> Flight: ...

    def acknowledged(self, flights: list[Flight], now_s: float) -> None: ...

    def lost(self, flights: list[Flight], now_s: float) -> None: ...


class CubicSender:
    """TCP with CUBIC, slow start and one reduction a round trip; ack-clocked, without pacing."""

    def __init__(self) -> None:
        self._cubic: Cubic | None = None
        self._slow_start = 10.0
        self._rate = DeliveryRate()
        self._under_way: set[Flight] = set()
        self._recovers_until_s = 0.0
        self._rtt_s = 0.1

    @property
    def window(self) -> float:
        return self._slow_start if self._cubic is None else self._cubic.window

    def next_send_s(self, size: int) -> float | None:
        return 0.0 if len(self._under_way) < self.window else None

    def sent(self, size: int, now_s: float) -> Flight:
        flight = self._rate.sent(size, now_s)
        self._under_way.add(flight)
        return flight

    def acknowledged(self, flights: list[Flight], now_s: float) -> None:
        for flight in self._under_way.intersection(flights):
            self._rtt_s = now_s - flight.sent_s
        self._under_way.difference_update(flights)
        if self._cubic is None:
            self._slow_start += len(flights)
        else:
            self._cubic.acknowledged(len(flights), now_s, self._rtt_s)

    def lost(self, flights: list[Flight], now_s: float) -> None:
        latest_s = max((flight.sent_s for flight in self._under_way.intersection(flights)), default=0.0)
        self._under_way.difference_update(flights)
        if latest_s <= self._recovers_until_s:
            return
        self._recovers_until_s = now_s
        if self._cubic is None:
            self._cubic = Cubic(self._slow_start, now_s, beta=0.7, scale=0.4)  # RFC 9438
        self._cubic.lost(now_s, 2)


@dataclass
class Flow:
    """One sender on a path; ``delivered`` holds the arrivals of its frames, in seconds."""

    sender: Sender
    start_s: float = 0.0
    end_s: float = float("inf")
    offered_bytes_s: float = float("inf")
    ack_every_s: float = 0.0
    delivered: list[float] = field(default_factory=list)
    outstanding: deque[Flight] = field(default_factory=deque)
    waiting_acks: list[Flight] = field(default_factory=list)
    ack_at_s: float = -1.0
    heard_s: float = 0.0
    sent_bytes: int = 0
    wakes_s: float = -1.0

    def overtaken_by(self, flights: list[Flight]) -> list[Flight]:
        """Remove what left up to the last of these flights; return what of it is not among them."""
        overtaken: list[Flight] = []
        if flights[-1] in self.outstanding:
            while (flight := self.outstanding.popleft()) is not flights[-1]:
                overtaken.append(flight)
        return [flight for flight in overtaken if flight not in flights]

    def share(self, begin_s: float, end_s: float, bits_s: float) -> float:
        """Return its delivered bytes in a span, of those that the path could carry."""
        frames = sum(1 for at in self.delivered if begin_s <= at < end_s)
        return frames * MTU * 8 / bits_s / (end_s - begin_s)


class SimulatedPath:
    """Flows on a bottleneck, and the queueing delay that each frame met."""

    def __init__(
        self, *, bits_s: float, rtt_s: float, fifo_bytes: int, loss: float = 0.0, burst: float = 1.0, seed: int = 1
    ) -> None:
        self.rtt_s = rtt_s
        self.now_s = 0.0
        self._fifo_bytes = fifo_bytes
        self._loss = Loss(loss, burst, seed)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self.queue_s: list[tuple[float, float]] = []
        self.flows: list[Flow] = []
        self.set_rate(bits_s)

    def set_rate(self, bits_s: float) -> None:
        """Change the bottleneck; what waits in it leaves at the old rate."""
        self.bits_s = bits_s
        self._channel = Channel(ConstantRate(bits_s), delay_ns=0, fifo_bytes=self._fifo_bytes, loss=self._loss)

    def add(self, flow: Flow) -> Flow:
        """Add a flow."""
        self.flows.append(flow)
        self.at(flow.start_s, lambda: self._send(flow))
        return flow

    def at(self, moment_s: float, work: Callable[[], None]) -> None:
        """Call at a moment."""
        heapq.heappush(self._events, (moment_s, next(self._order), work))

    def run(self, until_s: float) -> None:
        """Run until a moment."""
        while self._events and self._events[0][0] <= until_s:
            self.now_s, _, work = heapq.heappop(self._events)
            work()
        self.now_s = until_s

    def queue_quantile(self, begin_s: float, share: float) -> float:
        """Return a quantile of the queueing delay from a moment on, in seconds."""
        ordered = sorted(queue for at, queue in self.queue_s if at >= begin_s)
        return ordered[int(share * (len(ordered) - 1))]

    def _wake(self, flow: Flow, moment_s: float) -> None:
        if not self.now_s < flow.wakes_s <= moment_s:
            flow.wakes_s = moment_s
            self.at(moment_s, lambda: self._send(flow))

    def _send(self, flow: Flow) -> None:
        if flow.outstanding and self.now_s - flow.heard_s > max(_SILENCE_S, 4 * self.rtt_s):
            flow.heard_s = self.now_s
            flow.sender.lost(list(flow.outstanding), self.now_s)
            flow.outstanding.clear()
        while self.now_s < flow.end_s:
            if flow.sent_bytes > flow.offered_bytes_s * (self.now_s - flow.start_s):
                if isinstance(flow.sender, PathController):
                    flow.sender.app_limited()
                self._wake(flow, self.now_s + MTU / flow.offered_bytes_s)
                return
            next_s = flow.sender.next_send_s(MTU)
            if next_s is None:
                self._wake(flow, self.now_s + 2 * _SILENCE_S)
                return
            if next_s > self.now_s:
                self._wake(flow, next_s)
                return
            self._put(flow)

    def _put(self, flow: Flow) -> None:
        if not flow.outstanding:
            flow.heard_s = self.now_s
        flight = flow.sender.sent(MTU, self.now_s)
        flow.outstanding.append(flight)
        flow.sent_bytes += MTU
        due_ns = self._channel.offer(round(self.now_s * 1e9), MTU)
        if due_ns is None:
            return
        leaves_s = due_ns / 1e9
        self.queue_s.append((self.now_s, leaves_s - self.now_s - MTU * 8 / self.bits_s))
        arrives_s = leaves_s + self.rtt_s / 2
        self.at(arrives_s, lambda: self._arrive(flow, flight))

    def _arrive(self, flow: Flow, flight: Flight) -> None:
        flow.delivered.append(self.now_s)
        flow.waiting_acks.append(flight)
        if flow.ack_at_s < self.now_s:
            flow.ack_at_s = self.now_s + flow.ack_every_s
            self.at(flow.ack_at_s, lambda: self._acknowledge(flow))
        elif not flow.ack_every_s:
            self.at(self.now_s, lambda: self._acknowledge(flow))

    def _acknowledge(self, flow: Flow) -> None:
        flights, flow.waiting_acks = flow.waiting_acks, []
        if flights:
            self.at(self.now_s + self.rtt_s / 2, lambda: self._hear(flow, flights))

    def _hear(self, flow: Flow, flights: list[Flight]) -> None:
        flow.heard_s = self.now_s
        lost = flow.overtaken_by(flights)
        flow.sender.acknowledged(flights, self.now_s)
        if lost:
            flow.sender.lost(lost, self.now_s)
        self._send(flow)
