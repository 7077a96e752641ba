"""Packet capture of the frames on network devices, written as a pcap file.

    python -m gdp.ports.capture --iface eth0 --iface eth1 FILE

I/O. This command needs no other part of a node.
Source: packet(7); the pcap format, draft-ietf-opsawg-pcap, with nanosecond stamps (magic A1B23C4D)::

    file    magic (4)  2 (2)  4 (2)  zero (4)  zero (4)  longest frame (4)  link type 1, Ethernet (4)
    frame   seconds (4)  nanoseconds (4)  bytes here (4)  bytes on the wire (4)  frame

The capture holds every frame of both directions and of every EtherType, as an eavesdropper on the links sees it. With
several devices, a frame of one may precede an earlier frame of another; the stamps come from the kernel and are
correct. The command prints one JSON line when it starts to capture and one when it ends (on SIGINT or SIGTERM). The
file is complete at the end.
"""

from __future__ import annotations

import argparse
import json
import select
import signal
import socket
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Final

from gdp.errors import LocalError
from gdp.ports.sockets import NO_RAW_SOCKETS, kernel_drops, large_buffers

_ETH_P_ALL: Final = 0x0003
_SO_TIMESTAMPNS: Final = 35
_STAMP: Final = struct.Struct("@qq")
_FILE_HEAD: Final = struct.Struct("=IHHiIII")
_FRAME_HEAD: Final = struct.Struct("=IIII")
_MAGIC_NS: Final = 0xA1B23C4D
_LONGEST_BYTES: Final = 1 << 18
_BURST: Final = 256  # frames of one device before the next device is read


class Capture:
    """Sockets that receive every frame on some devices, and the file that they are written to.

    Args:
        file: open for writing bytes; the caller closes it.

    Raises:
        LocalError: a device does not exist, or the process may not open raw sockets.
    """

    def __init__(self, ifnames: Sequence[str], file: BinaryIO) -> None:
        self.frames = 0
        self._lost = 0
        self._file = file
        self._buffer = bytearray(_LONGEST_BYTES)
        self._sockets: list[socket.socket] = []
        try:
            for ifname in ifnames:
                self._sockets.append(_listen(ifname))
        except LocalError:
            self.close()
            raise
        file.write(_FILE_HEAD.pack(_MAGIC_NS, 2, 4, 0, 0, _LONGEST_BYTES, 1))
        file.flush()

    @property
    def lost(self) -> int:
        """Frames that the kernel dropped because the capture was too slow."""
        self._lost += sum(map(kernel_drops, self._sockets))
        return self._lost

    def run(self, stop: socket.socket) -> None:
        """Write frames until ``stop`` is readable; then write the frames that have already arrived, and return."""
        epoll = select.epoll()
        with epoll:
            for source in (stop, *self._sockets):
                epoll.register(source, select.EPOLLIN)
            heard = {opened.fileno(): opened for opened in self._sockets}
            while True:
                ready = {fd for fd, _ in epoll.poll()}
                for fd in ready & heard.keys():
                    self._write_burst(heard[fd])
                self._file.flush()
                if stop.fileno() in ready:
                    break
        for opened in self._sockets:
            while self._write_burst(opened) == _BURST:
                continue
        self._file.flush()

    def close(self) -> None:
        """Close every socket; the file stays open for its owner."""
        for opened in self._sockets:
            opened.close()

    def _write_burst(self, opened: socket.socket) -> int:
        """Write up to a burst of frames; return how many."""
        for count in range(_BURST):
            try:
                size, stamps, _, _ = opened.recvmsg_into([self._buffer], socket.CMSG_SPACE(_STAMP.size))
            except OSError:  # no more frames, or the device went down; it is read again when it is up
                return count
            seconds, nanoseconds = _STAMP.unpack(stamps[0][2]) if stamps else (0, 0)
            self._file.write(_FRAME_HEAD.pack(seconds, nanoseconds, size, size))
            self._file.write(memoryview(self._buffer)[:size])
            self.frames += 1
        return _BURST


def _listen(ifname: str) -> socket.socket:
    try:
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    except PermissionError as error:
        raise LocalError(NO_RAW_SOCKETS) from error
    try:
        large_buffers(opened)
        opened.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        opened.setblocking(False)
        opened.bind((ifname, _ETH_P_ALL))
    except OSError as error:
        opened.close()
        raise LocalError(f"device {ifname}: {error.strerror}") from error
    return opened


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 2 if a device or folder does not exist or the user lacks the right."""
    parser = argparse.ArgumentParser(
        prog="python -m gdp.ports.capture",
        description="Write every frame on some devices to a pcap file, until interrupted.",
        epilog="example: sudo python -m gdp.ports.capture --iface eth0 --iface eth1 seen.pcap",
    )
    parser.add_argument("--iface", action="append", required=True, help="a device to listen on; may be repeated")
    parser.add_argument("file", type=Path, help="the pcap file to write")
    options = parser.parse_args(arguments)
    stop, wake = socket.socketpair()
    wake.setblocking(False)
    before = {number: signal.signal(number, lambda *_: None) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.set_wakeup_fd(wake.fileno())
    try:
        with options.file.open("wb") as file:
            capture = Capture(options.iface, file)
            _say(event="ready", file=str(options.file))
            capture.run(stop)
            _say(event="done", frames=capture.frames, lost=capture.lost)
            capture.close()
    except (LocalError, OSError) as error:
        print(f"capture: {error}", file=sys.stderr)  # noqa: T201  (output of a command)
        return 2
    finally:
        signal.set_wakeup_fd(-1)
        for number, handler in before.items():
            signal.signal(number, handler)
        stop.close()
        wake.close()
    return 0


def _say(**facts: str | int) -> None:
    print(json.dumps(facts), flush=True)  # noqa: T201  (output of a command)


if __name__ == "__main__":
    sys.exit(main())
