"""Capture of the frames on devices, as an eavesdropper on the links sees them, into a pcap file.

    python -m ring.capture FILE DEVICE...

I/O; a process in the namespace of the devices. It reports when it begins and, after SIGINT or SIGTERM, how many frames
it has written. It holds every EtherType and both directions. With several devices, a frame of one may precede an
earlier frame of another; the stamps come from the kernel and are correct.
Source: packet(7).
"""

from __future__ import annotations

import signal
import socket
import struct
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Event
from typing import Final

from scapy.utils import RawPcapWriter

from gdp.ports.readiness import readable
from gdp.ports.sockets import kernel_drops, large_buffers
from ring.nodes.node import say

_ETH_P_ALL: Final = 0x0003
_SO_TIMESTAMPNS: Final = 35
_STAMP: Final = struct.Struct("@qq")
_ETHERNET: Final = 1  # link type of a pcap file
_LONGEST_BYTES: Final = 1 << 18
_BURST: Final = 256  # frames of one device before the next device is read
_LOOK_S: Final = 0.1


def capture(path: Path, devices: list[str], is_over: Event) -> tuple[int, int]:
    """Write frames until it is over; return how many, and how many the kernel dropped.

    Raises ``OSError``: no such device or folder, or not allowed.
    """
    frames, buffer = 0, bytearray(_LONGEST_BYTES)
    with ExitStack() as stack:
        sources = [stack.enter_context(_listen(device)) for device in devices]
        file = stack.enter_context(closing(RawPcapWriter(str(path), _ETHERNET, nano=True, snaplen=_LONGEST_BYTES)))
        file.write_header(None)
        file.flush()
        say("ready", file=str(path))
        while not is_over.is_set():
            readable(sources, _LOOK_S)
            frames += sum(_write_burst(source, buffer, file) for source in sources)
            file.flush()
        for source in sources:
            while written := _write_burst(source, buffer, file):
                frames += written
        return frames, sum(map(kernel_drops, sources))


def _listen(device: str) -> socket.socket:
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    large_buffers(opened)
    opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    opened.setblocking(False)
    opened.bind((device, _ETH_P_ALL))
    return opened


def _write_burst(source: socket.socket, buffer: bytearray, file: RawPcapWriter) -> int:
    """Write up to a burst of frames; return how many."""
    for count in range(_BURST):
        try:
            size, stamps, _, _ = source.recvmsg_into([buffer], socket.CMSG_SPACE(_STAMP.size))
        except OSError:  # no more frames, or the device went down; it is read again when it is up
            return count
        seconds, nanoseconds = _STAMP.unpack(stamps[0][2]) if stamps else (0, 0)
        file.write_packet(bytes(memoryview(buffer)[:size]), seconds, nanoseconds)
    return _BURST


def main() -> None:
    """Capture until ended."""
    is_over = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: is_over.set())
    frames, lost = capture(Path(sys.argv[1]), sys.argv[2:], is_over)
    say("done", frames=frames, lost=lost)


if __name__ == "__main__":
    main()
