"""Delay line of a site's uplink: a process that passes frames between two devices after a delay with jitter.

I/O; two AF_PACKET sockets. Run as ``python -m internet.line DEVICE DEVICE MS JITTER_MS``; it prints a line when it is
ready, and ends with its standard input. It replaces netem, which not every kernel has. Frames pass with their offload
header, so that a large segment of TCP costs no more than a small one, and no checksum is lost.
Source: packet(7), PACKET_VNET_HDR; Linux, include/uapi/linux/if_packet.h, for the numbers.
"""

from __future__ import annotations

import ctypes
import logging
import random
import select
import socket
import sys
import time
from typing import Final

from fog.providers.local.delay import DelayLine
from gdp.ports.sockets import large_buffers

log = logging.getLogger(__name__)

_ALL: Final = 3  # ETH_P_ALL
_SOL_PACKET, _OFFLOAD_HEADER, _IGNORE_OUTGOING = 263, 15, 23
_FRAME_BYTES: Final = (1 << 16) + 64
_BATCH: Final = 32
_MS_NS: Final = 1_000_000
_TIMER_SLACK: Final = 29  # PR_SET_TIMERSLACK


class _Delay:
    """Due times of frames: each direction keeps its order."""

    def __init__(self, delay_ms: float, jitter_ms: float) -> None:
        self._delay_ns, self._jitter_ns = round(delay_ms * _MS_NS), round(jitter_ms * _MS_NS)
        self._last_ns = [0, 0]

    def due_ns(self, side: int, now_ns: int) -> int:
        """Return when a frame that arrived now on a side is due."""
        due_ns = now_ns + self._delay_ns + (random.randrange(self._jitter_ns) if self._jitter_ns else 0)
        self._last_ns[side] = max(self._last_ns[side], due_ns)
        return self._last_ns[side]


def _open(device: str) -> socket.socket:
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    opened.setsockopt(_SOL_PACKET, _IGNORE_OUTGOING, 1)
    opened.setsockopt(_SOL_PACKET, _OFFLOAD_HEADER, 1)
    large_buffers(opened)
    opened.bind((device, _ALL))
    opened.setblocking(False)
    return opened


def _relay(sides: tuple[socket.socket, socket.socket], line: DelayLine, delay: _Delay) -> None:
    """Relay until the input ends."""
    control = sys.stdin.fileno()
    while True:
        ready, _, _ = select.select((*sides, control), (), (), line.pause_s(time.monotonic_ns()))
        for side, source in enumerate(sides):
            if source in ready:
                _receive(source, side, line, delay)
        if control in ready:
            return
        for side, frame in line.poll_frames(time.monotonic_ns()):
            try:
                sides[side].send(frame)
            except OSError:  # the device is down, or its queue is full
                line.dropped += 1


def _receive(source: socket.socket, side: int, line: DelayLine, delay: _Delay) -> None:
    for _ in range(_BATCH):
        try:
            frame = source.recv(_FRAME_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            log.info("a device went down reason=%s", error)
            return
        line.put(delay.due_ns(side, time.monotonic_ns()), side, frame)


def main() -> None:
    """Run the relay of the command line."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s internet.line %(message)s")
    ctypes.CDLL(None).prctl(_TIMER_SLACK, 1, 0, 0, 0)  # the default adds 50 us to each pause
    line, delay = DelayLine(0), _Delay(*map(float, sys.argv[3:]))
    with _open(sys.argv[1]) as one, _open(sys.argv[2]) as other:
        print("ready", flush=True)
        _relay((one, other), line, delay)
    if line.dropped:  # expected where an uplink was cut with frames under way
        log.warning("delay line %s-%s lost frames, device down or queue full count=%d", *sys.argv[1:3], line.dropped)


if __name__ == "__main__":
    main()
