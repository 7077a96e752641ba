"""Relay of a thin link: a process that passes frames between two devices through a channel for each direction.

I/O; two AF_PACKET sockets, whole batches a system call. Run as ``python -m thin_link.relay FILE``; the file holds JSON
with ``devices`` (from the robot, to the cloud), ``up`` and ``down`` (``Direction``) and ``seed``.
Each line on its standard input is answered by one line of JSON with all counters since the last one; one with the word
``rewind`` begins recordings and losses again. It ends with its input.

It runs under SCHED_FIFO where that is allowed, so the processes that it connects do not delay it. Its devices must have
no offloads: a channel counts frames, not segments of TCP.
Source: packet(7); Linux, include/uapi/linux/if_packet.h, for the numbers.
"""

from __future__ import annotations

import ctypes
import gc
import json
import logging
import os
import select
import socket
import sys
import time
from array import array
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from peers.jsonl import say
from report import percentile

from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES
from gdp.ports.mmsg import SLOTS, MmsgBatch
from gdp.ports.sockets import kernel_drops
from thin_link.channel import Channel
from thin_link.conditions import Direction

log = logging.getLogger(__name__)

MARKED_PORT: Final = 5_201  # of the TCP flow that is counted apart
_ALL: Final = 3  # ETH_P_ALL
_SOL_PACKET, _QDISC_BYPASS, _IGNORE_OUTGOING = 263, 20, 23
_SEND_BUFFER_FORCE, _RECEIVE_BUFFER_FORCE = 32, 33
_BUFFER_BYTES: Final = 64 << 20
_SLOT_BYTES: Final = 2_048
_BATCHES: Final = 4  # of one direction before the other one has its turn
_PRIORITY: Final = 20
_TIMER_SLACK: Final = 29  # PR_SET_TIMERSLACK
_EARLY_NS: Final = 30_000  # a frame may leave so much before it is due; waking costs as much
_PAUSE_NS: Final = 100_000  # shortest wait for a due frame, so that frames leave in batches
_TCP: Final = b"\x08\x00\x45"  # IPv4 without options, at the EtherType
_PORT: Final = MARKED_PORT.to_bytes(2, "big")


@dataclass(slots=True)
class _Way:
    """One direction: where frames come from and go to, and those that are not due."""

    source: socket.socket
    sink: socket.socket
    channel: Channel
    waiting: deque[tuple[int, bytes, bytes]] = field(default_factory=deque)  # due, Ethernet header, rest


class _Relay:
    """Relay between two devices."""

    def __init__(self, sides: tuple[socket.socket, socket.socket], channels: tuple[Channel, Channel]) -> None:
        one, other = sides
        self._ways = (_Way(one, other, channels[0]), _Way(other, one, channels[1]))
        self._batch = MmsgBatch(_SLOT_BYTES)
        self._drops = [0] * (max(DropReason) + 1)
        self._oversized = 0
        self._late_ns = array("q")  # of each frame since the last report
        self._start_ns = time.monotonic_ns()

    def run(self, control: int) -> None:
        """Relay until the control input ends."""
        sources: list[socket.socket | int] = [*(way.source for way in self._ways), control]
        while True:
            ready, _, _ = select.select(sources, (), (), self._pause_s())
            for way in self._ways:
                if way.source in ready:
                    self._receive(way)
            for way in self._ways:
                self._send_due(way)
            if control in ready:
                order = os.read(control, 1 << 10)
                if not order:
                    return
                if b"rewind" in order:
                    self._rewind()
                self._report()

    def _pause_s(self) -> float | None:
        due = [way.waiting[0][0] for way in self._ways if way.waiting]
        if not due:
            return None
        left_ns = min(due) - (time.monotonic_ns() - self._start_ns)
        return 0.0 if left_ns <= _EARLY_NS else max(left_ns, _PAUSE_NS) / 1e9

    def _receive(self, way: _Way) -> None:
        batch, pool, waiting, offer = self._batch, self._batch.pool, way.waiting, way.channel.offer
        for _ in range(_BATCHES):
            sizes = batch.receive(way.source)
            now_ns = time.monotonic_ns() - self._start_ns
            for slot, size in enumerate(sizes):
                at = slot * _SLOT_BYTES
                if size + ETHER_BYTES >= _SLOT_BYTES:  # a segment of an offload, cut
                    self._oversized += 1
                    continue
                is_marked = pool[at + 12 : at + 15] == _TCP and _PORT in (
                    pool[at + 34 : at + 36],
                    pool[at + 36 : at + 38],
                )
                due_ns = offer(now_ns, size, is_marked=is_marked)
                if due_ns is not None:
                    body = at + ETHER_BYTES
                    waiting.append((due_ns, bytes(pool[at:body]), bytes(pool[body : body + size])))
            if len(sizes) < SLOTS:
                return

    def _send_due(self, way: _Way) -> None:
        """Send the due frames, a batch for each run of frames with one Ethernet header."""
        waiting, late_ns = way.waiting, self._late_ns
        while waiting:
            now_ns = time.monotonic_ns() - self._start_ns
            if waiting[0][0] > now_ns + _EARLY_NS:
                return
            head, frames = waiting[0][1], list[bytes]()
            while waiting and len(frames) < SLOTS and waiting[0][0] <= now_ns + _EARLY_NS and waiting[0][1] == head:
                due_ns, _, frame = waiting.popleft()
                late_ns.append(max(now_ns - due_ns, 0))
                frames.append(frame)
            self._batch.send(way.sink, frames, head, self._drops)

    def _rewind(self) -> None:
        now_ns = time.monotonic_ns() - self._start_ns
        for way in self._ways:
            way.channel.rewind(now_ns)

    def _report(self) -> None:
        now_ns = time.monotonic_ns() - self._start_ns
        up, down = (asdict(way.channel.take_flow(now_ns)) for way in self._ways)
        say(
            oversized=self._oversized,
            refused=sum(self._drops),
            kernel_drops=sum(kernel_drops(way.source) for way in self._ways),
            late_us=percentile(self._late_ns, 0.99) / 1e3 if self._late_ns else 0.0,
            up=up,
            down=down,
        )
        self._late_ns = array("q")
        self._drops, self._oversized = [0] * len(self._drops), 0


def open_device(device: str, ethertype: int = _ALL) -> socket.socket:
    """Open a socket that does not block, for frames of this type; 0: none comes.

    Raises ``OSError``: no such device, or not allowed.
    """
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    try:
        opened.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
        opened.setsockopt(_SOL_PACKET, _QDISC_BYPASS, 1)
        for force in (_SEND_BUFFER_FORCE, _RECEIVE_BUFFER_FORCE):
            opened.setsockopt(socket.SOL_SOCKET, force, _BUFFER_BYTES)
        opened.bind((device, ethertype))
        opened.setblocking(False)
    except OSError:
        opened.close()
        raise
    return opened


def _be_first() -> None:
    """Take precedence over ordinary processes, and keep pauses exact."""
    ctypes.CDLL(None).prctl(_TIMER_SLACK, 1, 0, 0, 0)  # the default adds 50 us to each pause
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # others learn to use another core
    gc.disable()  # a frame makes no cycle; a collection would delay the next ones
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except PermissionError:
        log.warning("the ordinary scheduler: not allowed to set SCHED_FIFO")


def main() -> None:
    """Run the relay of the command line."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    settings: Mapping[str, Any] = json.loads(Path(sys.argv[1]).read_text(encoding="ascii"))
    directions = [Direction(**settings[side]) for side in ("up", "down")]
    seed = int(settings["seed"])
    up, down = (each.channel(2 * seed + at) for at, each in enumerate(directions))
    one, other = settings["devices"]
    _be_first()
    with open_device(one) as robot, open_device(other) as cloud:
        relay = _Relay((robot, cloud), (up, down))
        say(event="ready")
        relay.run(sys.stdin.fileno())


if __name__ == "__main__":
    main()
