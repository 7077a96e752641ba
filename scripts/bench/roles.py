"""Processes of the forwarding bench, each in a namespace of its own: ``switch`` and ``end``.

Started by ``chains.py``. Each reads commands as JSON lines on stdin and answers each with a JSON line. An end has
AF_PACKET sockets on one device; frames are prepared in advance. One that *polls* queries its socket continuously and
measures the path alone. One that *sleeps* waits in epoll, as a real node does, and measures the scheduler too. The sink
checks for frames every half millisecond: a wake-up for each would be paid by the sender, in whose time the kernel
forwards.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import select
import socket
import struct
import sys
import time
from array import array
from collections.abc import Callable
from contextlib import closing
from itertools import repeat
from typing import Any, Final, NamedTuple

from frames import SINK, SOURCE
from peers.jsonl import order_waits, read_order, say

from gdp.errors import LocalError
from gdp.frame.codec import ETHER_BYTES
from gdp.ports.mmsg import SLOTS, MmsgPool, make_batch
from gdp.ports.netdev import NetdevPlane
from gdp.ports.sockets import kernel_drops
from gdp.switch.table import Table

_SOL_PACKET, _QDISC_BYPASS = 263, 20
_SO_ATTACH_FILTER, _SO_SNDBUFFORCE, _SO_RCVBUFFORCE = 26, 32, 33
_RETURN: Final = 0x06  # BPF_RET | BPF_K
_BUFFER_BYTES: Final = 64 << 20
_SLOT_BYTES: Final = 64  # bytes that the sink reads of a frame
_NAP_S: Final = 0.0005
_PATIENCE_S: Final = 1.0
_LOOKS: Final = 2_000_000  # empty polls of a polling endpoint: about a second
_FRAME_MAX: Final = 1 << 16
_WARM: Final = 50  # warm-up pings, not counted
_DONTWAIT: Final = int(socket.MSG_DONTWAIT)


class Sent(NamedTuple):
    """Result of a source; moments are monotonic seconds."""

    sent: int
    refused: int
    start_s: float
    end_s: float
    cpu_s: float


class Counted(NamedTuple):
    """Frames that a sink received; ``drops``: frames that found its buffer full."""

    got: int
    drops: int
    last_s: float


def open_end(ifname: str, ethertype: int, *, cut_bytes: int = 0) -> socket.socket:
    """Open a socket that does not block; EtherType 0 only sends.

    ``cut_bytes``: keep so much of each frame (0: all), so that long ones are not copied. Raises ``OSError``: no such
    device, or not allowed.
    """
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    try:
        opened.setsockopt(_SOL_PACKET, _QDISC_BYPASS, 1)
        for force in (_SO_SNDBUFFORCE, _SO_RCVBUFFORCE):
            opened.setsockopt(socket.SOL_SOCKET, force, _BUFFER_BYTES)
        if cut_bytes:
            step = array("B", struct.pack("=HBBI", _RETURN, 0, 0, cut_bytes))
            opened.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", 1, step.buffer_info()[0]))
        opened.setblocking(False)
        opened.bind((ifname, ethertype))
    except OSError:
        opened.close()
        raise
    return opened


def send(ifname: str, frame: bytes, rate: float | None, seconds: float) -> Sent:
    """Send a whole frame again and again, at ``rate`` frames/s (None: flat out)."""
    batch, head, drops = make_batch(len(frame)), frame[:ETHER_BYTES], [0] * 64
    batch.fill([frame[ETHER_BYTES:]] * SLOTS)
    with open_end(ifname, 0) as sock:
        cpu_s, start_s = time.process_time(), time.monotonic()
        if rate is None:
            sent = 0
            while time.monotonic() < start_s + seconds:
                sent += batch.forward(sock, 0, SLOTS, head, drops)
        else:
            sent = _paced(sock, batch, head, drops, rate, int(rate * seconds))
        return Sent(sent, sum(drops), start_s, time.monotonic(), time.process_time() - cpu_s)


def _paced(sock: socket.socket, batch: MmsgPool, head: bytes, drops: list[int], rate: float, total: int) -> int:
    burst = max(1, min(SLOTS, int(rate / 1000)))
    offered, sent, start_s = 0, 0, time.monotonic()
    while offered < total:
        behind = (time.monotonic() - start_s) * rate - offered
        if behind < burst:
            time.sleep((burst - behind) / rate)
            continue
        sent += batch.forward(sock, 0, burst, head, drops)
        offered += burst
    return sent


def count_frames(ifname: str, ethertype: int, ready: Callable[[], None], asked: Callable[[], int | None]) -> Counted:
    """Count frames until all expected ones have arrived or no more come.

    ``ifname``: the device. ``ethertype``: of the frames. ``ready``: called when counting begins. ``asked``: returns the
    expected number once the source is done, None before that; only called when nothing came.
    """
    silence_s, expected, got, last_s = 0.2, None, 0, 0.0
    batch = make_batch(_SLOT_BYTES)
    with open_end(ifname, ethertype, cut_bytes=_SLOT_BYTES) as sock:
        ready()
        while True:
            came = len(batch.receive(sock))
            if came:
                got += came
                last_s = time.monotonic()
                continue
            if expected is None:
                expected = asked()
                asked_s = time.monotonic()
            if expected is not None and (got >= expected or time.monotonic() - max(last_s, asked_s) > silence_s):
                return Counted(got, kernel_drops(sock), last_s)
            time.sleep(_NAP_S)


class _Ear:
    """Receiver of one frame at a time, as cheap as Python allows: the C library's ``recv`` into fixed memory."""

    def __init__(self, sock: socket.socket) -> None:
        recv = ctypes.CDLL(None).recv
        recv.argtypes, recv.restype = (ctypes.c_int, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int), ctypes.c_ssize_t
        self._recv = recv
        self._memory = ctypes.create_string_buffer(_FRAME_MAX)
        self._arguments = (sock.fileno(), ctypes.addressof(self._memory), _FRAME_MAX, _DONTWAIT)
        self._epoll = select.epoll()
        self._epoll.register(sock, select.EPOLLIN)

    def close(self) -> None:
        self._epoll.close()

    def poll(self) -> bool:
        """Query the socket continuously; False when nothing came for about a second."""
        recv, (fd, at, size, flags) = self._recv, self._arguments
        for _ in repeat(None, _LOOKS):  # noqa: SIM110  (a generator would make every poll more expensive)
            if recv(fd, at, size, flags) > 0:
                return True
        return False

    def sleep(self) -> bool:
        """Wait in epoll; False when nothing came for a second."""
        return bool(self._epoll.poll(_PATIENCE_S)) and self._recv(*self._arguments) > 0


def ping(ifname: str, ethertype: int, frame: bytes, pings: int, *, poll: bool) -> list[float]:
    """Return round-trip times in microseconds; a frame is sent again when the last one is back.

    Lost frames are left out. The function gives up after three lost frames.
    """
    times, lost, now = [], 0, time.perf_counter
    with open_end(ifname, ethertype) as sock, closing(_Ear(sock)) as ear:
        send_frame, take = sock.send, ear.poll if poll else ear.sleep
        for _ in range(pings + _WARM):
            start = now()
            send_frame(frame)
            if take():
                times.append(now() - start)
            else:
                lost += 1
                if lost == 3:
                    break
    return [each * 1e6 for each in times[_WARM:]]


def answer_pings(
    ifname: str, ethertype: int, frame: bytes, pings: int, ready: Callable[[], None], *, poll: bool
) -> int:
    """Answer as many pings as ``ping`` sends, with ``frame``, or until none comes for a while; return their number."""
    answered = 0
    with open_end(ifname, ethertype) as sock, closing(_Ear(sock)) as ear:
        send_frame, take = sock.send, ear.poll if poll else ear.sleep
        ready()
        while answered < pings + _WARM and take():
            send_frame(frame)
            answered += 1
    return answered


_ENTRIES_MAX: Final = 1_024
_LEASE_S: Final = 1e9


def make_plane(kind: str, ifnames: list[str], table: Table) -> NetdevPlane:
    """Return a plane by its name in the benches.

    Raises ``LocalError``: it is not available here; the text gives the reason.
    """
    if kind == "scapy":
        from gdp.ports.scapy_plane import ScapyPlane

        return ScapyPlane(ifnames, table)
    if kind == "raw":
        from gdp.ports.raw import RawPlane

        return RawPlane(ifnames, table)
    from gdp.ports.kernel.plane import KernelPlane

    return KernelPlane(ifnames, table, entries_max=_ENTRIES_MAX, peer=kind == "kernel")


def switch(plane: str, ways: dict[str, str], **_: Any) -> None:
    """Forward by a static table until stdin closes.

    ``plane``: which one. ``ways``: the devices towards the source ("left") and the sink ("right"), each "device
    neighbour's-MAC" in hex.
    """
    left, right = (ways[side].split() for side in ("left", "right"))
    table = Table(_ENTRIES_MAX)
    try:
        made = make_plane(plane, [left[0], right[0]], table)
    except LocalError as error:
        say(refused_because=str(error))
        return
    own = {port.ifname: port for port in made.ports.values()}
    for name, (ifname, mac) in ((SINK, right), (SOURCE, left)):
        table.install(name, ((own[ifname].index, bytes.fromhex(mac) + own[ifname].mac),), _LEASE_S)
    made.watch(sys.stdin, sys.exit)
    gc.collect()
    gc.freeze()
    say(event="ready")
    with closing(made):
        while True:
            made.poll(None)


def end(ifname: str, **_: Any) -> None:
    """Send, count, ping or answer on one device, as commanded."""
    say(event="ready")
    gc.freeze()
    gc.disable()
    while True:
        order = read_order()
        ethertype = order.get("ethertype", 0)
        frame = bytes.fromhex(order.get("frame", ""))
        if order["do"] == "send":
            say(**send(ifname, frame, order["rate"], order["seconds"])._asdict())
        elif order["do"] == "count":
            say(**count_frames(ifname, ethertype, ready, expected)._asdict())
        elif order["do"] == "ping":
            say(rtt_us=ping(ifname, ethertype, frame, order["pings"], poll=order["poll"]))
        elif order["do"] == "answer":
            say(answered=answer_pings(ifname, ethertype, frame, order["pings"], ready, poll=order["poll"]))


def expected() -> int | None:
    """Return how many frames the source has sent, once the bench has reported it."""
    return int(read_order()["expected"]) if order_waits() else None


def ready() -> None:
    """Report that the process is ready."""
    say(event="ready")


if __name__ == "__main__":
    settings = json.loads(sys.argv[1])
    if (cpu := settings.pop("cpu")) is not None:
        os.sched_setaffinity(0, {cpu})
    if settings.pop("role") == "switch":
        switch(**settings)
    else:
        end(**settings)
