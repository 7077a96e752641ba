"""Data plane on AF_PACKET sockets: it receives batches, decides on each frame, and sends batches.

I/O; without Scapy, and with the struct codec's offsets only.
Source: docs/explanation/design.md, section 7.
One pass over the batch decides the ordinary frames here. ``gdp.switch.forwarder.decide`` decides all others, and
fixtures hold the two decisions equal. Consecutive frames of a batch with the same hops leave in one call, a *run*. Each
traffic class of a port has its own socket, and the first one is served first. A port accepts a limited number of
hellos and of strangers' frames per second. The kernel keeps the others, and drops them when the socket is full::

    receive | A A A A B B A |    decide      runs: A A A A | B B | A      forward, forward, forward
"""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Final

from gdp.errors import DropReason, LocalError
from gdp.frame.codec import (
    CONTROL_FROM,
    ETHER_BYTES,
    FLAGS_AT,
    HOPS_AT,
    KIND_AT,
    OVERHEAD_BYTES,
    Flag,
)
from gdp.intervals import Rate
from gdp.names import NAME_BYTES
from gdp.ports.mmsg import make_batch, put_one
from gdp.ports.netdev import NetdevPlane
from gdp.ports.plane import MAC_BYTES, Port
from gdp.ports.sockets import (
    TrafficClass,
    attach_drop_all_filter,
    keep_arrival_times,
    kernel_drops,
    open_port,
    tell_neighbours,
)
from gdp.sansio import ReceivedFrame
from gdp.switch.forwarder import Drop, Forward, decide
from gdp.switch.table import NOWHERE, Hops, Table, is_side
from gdp.token_bucket import TokenBucket

_URGENT: Final = int(Flag.URGENT)
_CLASSES: Final = (
    TrafficClass.HELLO,
    TrafficClass.CONTROL,
    TrafficClass.URGENT,
    TrafficClass.ORDINARY,
    TrafficClass.GUEST,
)  # in the order of service: what follows a hello needs the session that it opens
_GREETINGS: Final = Rate(500.0, burst=128.0)  # per second, and at once; each costs at most 30 us before its rejection


def _traffic_class_of(frame: bytes) -> TrafficClass:
    if frame[KIND_AT] >= CONTROL_FROM:
        return TrafficClass.CONTROL
    return TrafficClass.URGENT if frame[FLAGS_AT] & _URGENT else TrafficClass.ORDINARY


class RawPlane(NetdevPlane):
    """``Plane`` over AF_PACKET.

    Raises:
        LocalError: as ``add_port``.
    """

    def __init__(self, ifnames: Sequence[str] = (), table: Table | None = None) -> None:
        self._sockets_by_class: dict[TrafficClass, dict[int, socket.socket]] = {
            traffic_class: {} for traffic_class in _CLASSES
        }  # by port
        self._batch = make_batch(OVERHEAD_BYTES)
        self._neighbours: dict[int, frozenset[bytes]] = {}  # addresses, by port
        self._closing = Closing()
        self._resting: dict[int, tuple[socket.socket, float]] = {}  # sockets that pause until then, by file descriptor
        super().__init__(ifnames, table)

    def _open(self, port: Port) -> None:
        self._closing.wait(port.ifname)
        self._widen(port)
        try:
            for rank, traffic_class in enumerate(_CLASSES):
                self._open_traffic_class(port, traffic_class, rank)
        except LocalError:
            self._shut(port)
            raise

    def _open_traffic_class(self, port: Port, traffic_class: TrafficClass, rank: int) -> None:
        sockets = self._sockets_by_class[traffic_class]
        opened = sockets[port.index] = open_port(port.ifname, traffic_class)
        if self._entries is None:
            keep_arrival_times(opened)
            ready: Callable[[], None] = partial(self._punt_all, port.index, opened)
        else:
            ready = self._forwarding(self._entries, self._sides, port.index, opened, sockets)
        if traffic_class in (TrafficClass.HELLO, TrafficClass.GUEST):
            ready = partial(self._take_some, opened, TokenBucket(*_GREETINGS), ready)
        self.watch(opened, ready, rank=rank)
        tell_neighbours(opened, traffic_class, self._neighbours.get(port.index, ()))

    def set_neighbours(self, port: int, macs: Collection[bytes]) -> None:
        """Store the addresses of a port's neighbours: their frames get a class ahead of strangers'."""
        before, after = self._neighbours.get(port, frozenset()), frozenset(macs)
        self._neighbours[port] = after
        steps = (
            (TrafficClass.GUEST, before & after),
            (TrafficClass.CONTROL, after),
            (TrafficClass.HELLO, after),
            (TrafficClass.GUEST, after),
        )
        for traffic_class, known in steps:  # in this order, so that each frame always has a traffic class
            opened = self._sockets_by_class[traffic_class].get(port)
            if opened is not None:
                tell_neighbours(opened, traffic_class, known)

    def poll(self, timeout_s: float | None) -> Sequence[ReceivedFrame]:
        """End the pauses of sockets that are due; then as ``Plane.poll``."""
        if self._resting:
            now_s = time.monotonic()
            for fd in [fd for fd, (_, until_s) in self._resting.items() if until_s <= now_s]:
                self._end_rest(fd)
            if self._resting:
                left_s = min(until_s for _, until_s in self._resting.values()) - now_s
                timeout_s = left_s if timeout_s is None else min(timeout_s, left_s)
        return super().poll(timeout_s)

    def close(self) -> None:
        """Close every port, the link monitor and the epoll."""
        super().close()
        self._closing.wait()

    def remove_port(self, index: int) -> None:
        """Close a port and forget its neighbours."""
        super().remove_port(index)
        self._neighbours.pop(index, None)

    def _take_some(self, source: socket.socket, quota: TokenBucket, ready: Callable[[], None]) -> None:
        """Receive a batch; pause the socket if it exceeded its quota."""
        before = self._counters.frames_in
        ready()
        now_s = time.monotonic()
        quota.charge(now_s, self._counters.frames_in - before)  # afterwards: only then is the batch's size known
        rest_s = -quota.left(now_s) / _GREETINGS[0]
        if rest_s > 0 and source.fileno() not in self._resting:
            self._epoll.unregister(source)
            self._resting[source.fileno()] = source, now_s + rest_s

    def _end_rest(self, fd: int) -> None:
        if self._resting.pop(fd, None) is not None:
            self._epoll.register(fd, select.EPOLLIN)

    def _widen(self, port: Port) -> None:
        if port.mtu + ETHER_BYTES > self._batch.slot_bytes:
            self._batch = make_batch(port.mtu + ETHER_BYTES)

    def _shut(self, port: Port) -> None:
        held = [sockets for sockets in self._sockets_by_class.values() if port.index in sockets]
        self._finish([sockets[port.index] for sockets in held])
        opened = [sockets.pop(port.index) for sockets in held]
        for each in opened:
            self._end_rest(each.fileno())
            self.unwatch(each)
        self._closing.close(port.ifname, [each.close for each in opened])

    def _finish(self, sources: Sequence[socket.socket]) -> None:
        """Receive the frames at sockets before they are closed, because closing loses them uncounted."""
        for source in sources:
            attach_drop_all_filter(source)
            # Clears the error of a device that went down, which the next read would return first.
            source.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            ready, before = self._ready.get(source.fileno()), -1
            while ready is not None and self._counters.frames_in > before:
                before = self._counters.frames_in
                ready()
        self._audit()

    def _is_open(self, index: int) -> bool:
        return index in self._sockets_by_class[TrafficClass.ORDINARY]

    def _kernel_drops(self) -> int:
        return sum(kernel_drops(opened) for sockets in self._sockets_by_class.values() for opened in sockets.values())

    def transmit(self, port: int, destination_mac: bytes, frames: Sequence[bytes]) -> int:
        """Send frames to one neighbour; return how many were sent, as ``Plane.transmit``."""
        counters, drops, facts, send = self._counters, self._counters.drops, self._ports.get(port), self._batch.send
        if facts is None or not facts.up:
            drops[DropReason.PORT_DOWN] += len(frames)
            return 0
        fitting = frames
        if max(map(len, frames), default=0) > facts.mtu:
            fitting = [frame for frame in frames if len(frame) <= facts.mtu]
            drops[DropReason.TOO_BIG] += len(frames) - len(fitting)
        if not fitting:
            return 0
        sink = self._sockets_by_class[_traffic_class_of(fitting[0])][port]
        macs = destination_mac + facts.mac
        left = put_one(sink, fitting[0], macs, drops) if len(fitting) == 1 else send(sink, fitting, macs, drops)
        counters.frames_out += left
        return left

    def _punt_all(self, port: int, source: socket.socket) -> None:
        arrivals = self._batch.receive_frames(source, port)
        self._counters.frames_in += len(arrivals)
        self._came[port] += len(arrivals)
        self._keep(arrivals)

    def _forwarding(
        self,
        entries: Mapping[bytes, Hops],
        sides: Mapping[bytes, int],
        port: int,
        source: socket.socket,
        sinks: Mapping[int, socket.socket],
    ) -> Callable[[], None]:
        """Return what receives one batch from a port, forwards it by ``sinks``, and punts the frames for the node."""
        counters, mtus, paces, came_by = self._counters, self._mtus, self._paces, self._came

        def route(key: bytes, largest: int) -> Sequence[tuple[int, bytes]]:
            """Return the hops of frames whose key alone decides; none if one of the links is down or too narrow."""
            hops = entries.get(key)
            if hops is None:
                hops = entries.get(key[:NAME_BYTES], NOWHERE)
            if key in paces or (key in sides and not is_side(sides[key], port)):
                return ()
            leads = []
            for hop in hops:
                if largest > mtus.get(hop[0], 0):
                    return ()
                leads.append((sinks[hop[0]].fileno(), hop[1]))
            return leads

        def consider(received: bytes) -> None:
            """Decide on one frame with the reference, and act on the decision."""
            decision = decide(received, entries, mtus, sides, port, paces)
            if isinstance(decision, Drop):
                counters.drops[decision.reason] += 1
            elif isinstance(decision, Forward):
                for reason in decision.lost:
                    counters.drops[reason] += 1
                frame = bytearray(received[ETHER_BYTES:])
                frame[HOPS_AT] -= 1
                count(sum(put_one(sinks[hop[0]], frame, hop[1], counters.drops) for hop in decision.hops))
            else:
                self._keep([ReceivedFrame(port, received[MAC_BYTES : 2 * MAC_BYTES], received[ETHER_BYTES:])])

        def count(left: int) -> None:
            counters.forwarded += left
            counters.frames_out += left

        def forward() -> None:
            came, left = self._batch.forward(source, route, consider, counters.drops)
            counters.frames_in += came
            came_by[port] += came
            count(left)

        return forward


class Closing:
    """What a plane has given up, and the kernel still holds: it takes 8 to 30 ms (a grace period of RCU) to close each.

    A port has seven sockets or bpf links. Without a thread, a switch would do nothing for 100 ms when a robot leaves
    it.
    """

    def __init__(self) -> None:
        self._threads: list[tuple[str, threading.Thread]] = []  # each with its device

    def close(self, ifname: str, closes: Sequence[Callable[[], object]]) -> None:
        """Call these, which belong to one device, one after the other in a thread, whatever one raises."""
        if not closes:
            return
        stack = ExitStack()
        for close in reversed(closes):
            stack.callback(close)
        thread = threading.Thread(target=stack.close, name="closing", daemon=True)
        self._threads.append((ifname, thread))
        thread.start()

    def wait(self, ifname: str | None = None) -> None:
        """Wait until a device, or all, is closed, as it must be before it is opened again."""
        for name, thread in self._threads:
            if ifname in (None, name):
                thread.join()
        self._threads = [each for each in self._threads if each[1].is_alive()]
