"""Delay line between two devices: each frame leaves on the other device after a fixed time, in both directions.

I/O; two AF_PACKET sockets, hence CAP_NET_RAW. Run as ``python -m fog.providers.local.delay DEVICE DEVICE MS``. It
starts when it reads a line on its standard input (see ``spawn``), and ends when a device is removed. It replaces netem,
which not every kernel has. A frame costs about 20 us, so it carries about ten thousand frames a second.
Source: packet(7); Linux, include/uapi/linux/if_packet.h and include/uapi/asm-generic/socket.h for the numbers.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import struct
import sys
import time
from collections import deque
from typing import Final

log = logging.getLogger(__name__)

_ALL: Final = 3  # ETH_P_ALL
_SOL_PACKET, _QDISC_BYPASS, _IGNORE_OUTGOING = 263, 20, 23
_TIMESTAMP_NS, _RCVBUF_FORCE = 35, 33
_BUFFER_BYTES: Final = 16 << 20
_FRAME_BYTES: Final = 1 << 16
_WAITING_BYTES: Final = 64 << 20
_BATCH: Final = 32
_STAMP: Final = struct.Struct("=qq")  # struct timespec of a 64-bit machine


class DelayLine:
    """Delayed frames of both directions, ordered by due time.

    Args:
        most_bytes: limit of queued bytes; frames beyond it are dropped and counted.
    """

    def __init__(self, delay_ns: int, most_bytes: int = _WAITING_BYTES) -> None:
        self.dropped = 0
        self._delay_ns = delay_ns
        self._free_bytes = most_bytes
        self._waiting: deque[tuple[int, int, bytes]] = deque()

    def put(self, arrived_ns: int, side: int, frame: bytes) -> None:
        """Queue a frame that arrived on a side."""
        if len(frame) > self._free_bytes:
            self.dropped += 1
            return
        self._free_bytes -= len(frame)
        self._waiting.append((arrived_ns + self._delay_ns, 1 - side, frame))

    def poll_frames(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Return the due frames, each with its outgoing side."""
        due = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, side, frame = self._waiting.popleft()
            self._free_bytes += len(frame)
            due.append((side, frame))
        return due

    def pause_s(self, now_ns: int) -> float | None:
        """Return the time until the next frame is due; None: the queue is empty."""
        return max(self._waiting[0][0] - now_ns, 0) / 1e9 if self._waiting else None


def _open(device: str) -> socket.socket:
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    opened.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
    opened.setsockopt(_SOL_PACKET, _QDISC_BYPASS, 1)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    try:
        opened.setsockopt(socket.SOL_SOCKET, _RCVBUF_FORCE, _BUFFER_BYTES)
    except PermissionError:
        log.warning("a short buffer: not root of the machine device=%s", device)
    opened.setsockopt(socket.SOL_SOCKET, _TIMESTAMP_NS, 1)
    opened.bind((device, _ALL))
    opened.setblocking(False)
    return opened


def _relay(sides: tuple[socket.socket, socket.socket], line: DelayLine) -> None:
    """Relay until a device is removed."""
    while True:
        ready, _, _ = select.select(sides, (), (), line.pause_s(time.time_ns()))
        for source in ready:
            for _ in range(_BATCH):
                try:
                    frame, extra, _, _ = source.recvmsg(_FRAME_BYTES, 64)
                except BlockingIOError:
                    break
                seconds, ns = _STAMP.unpack_from(extra[0][2])
                line.put(seconds * 1_000_000_000 + ns, sides.index(source), frame)
        for side, frame in line.poll_frames(time.time_ns()):
            try:
                sides[side].send(frame)
            except OSError:  # its queue is full, or the other end of its pair is down
                line.dropped += 1


def main() -> None:
    """Run the relay of the command line."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    first, second, ms = sys.argv[1:]
    if not sys.stdin.readline():
        return
    line = DelayLine(int(float(ms) * 1e6))
    with _open(first) as one, _open(second) as other:
        os.write(sys.stdout.fileno(), b"ready\n")  # one write, because the starter reads only once
        try:
            _relay((one, other), line)
        except OSError as error:
            log.info("a device is gone, so is the delay reason=%s dropped=%d", error, line.dropped)


if __name__ == "__main__":
    main()
