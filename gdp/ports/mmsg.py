"""mmsg pool: many frames per system call, received from one port into slots and forwarded from them to another.

I/O; no forwarding decision is made here.
Source: recvmmsg(2), sendmmsg(2), in the compiled burst core or through ctypes. One slot holds one frame from its
Ethernet header on::

    slot i      [ Ethernet header 14 | frame ... ]     receive() fills slots from the first on
    on leaving  [ head 14 ] + [ frame ... ]            forward() gathers a new Ethernet header and the frame in its slot

A forwarded frame is therefore never copied here: its hops left change in the slot, and one head serves a whole run of
frames to the same neighbour. A frame of our own is not copied either: ``send`` points at the bytes of the caller.
"""

from __future__ import annotations

import ctypes
import errno
import socket
from array import array
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

from gdp import burst
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, ETHERTYPE, HOPS_AT
from gdp.ports.sockets import waited_s
from gdp.sansio import ReceivedFrame

SLOTS: Final = 64
_TAKE_BYTES: Final = 128 << 10  # approximate size of one batch, so that urgent frames wait only briefly
_ETHERTYPE: Final = ETHERTYPE.to_bytes(2, "big")
_DONTWAIT: Final = int(socket.MSG_DONTWAIT)

_ONE_LESS: Final = bytes([255, *range(255)])  # of hops left
Route = Callable[[bytes, int], Sequence[tuple[int, bytes]]]

_SEND_ERRORS: Final = {
    errno.ENOBUFS: (DropReason.PORT_FULL, True),
    errno.EAGAIN: (DropReason.PORT_FULL, False),
    errno.EMSGSIZE: (DropReason.TOO_BIG, True),
}


def send_failure(number: int) -> tuple[DropReason, bool]:
    """Return the drop reason for the errno of a send, and whether the frames after it may still be sent."""
    return _SEND_ERRORS.get(number, (DropReason.PORT_DOWN, False))


def _most_at_once(slot_bytes: int) -> int:
    """Return how many frames one batch takes."""
    return max(8, min(SLOTS, _TAKE_BYTES // slot_bytes))


def _count_lost(drops: list[int], number: int, left: int) -> int:
    """Count the frames that are lost by the errno of a send, and return how many of those ``left`` these are."""
    reason, goes_on = send_failure(number)
    lost = 1 if goes_on else left
    drops[reason] += lost
    return lost


def _send_all(send: Callable[[int], int], at: int, end: int, drops: list[int]) -> int:
    """Send frames ``at`` to ``end``; ``send`` returns how many left from a place on, or minus the errno."""
    left = 0
    while at < end:
        sent = send(at)
        left += max(sent, 0)
        at += sent if sent > 0 else _count_lost(drops, -sent, end - at)
    return left


class _IoVec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MsgHdr(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _MmsgHdr(ctypes.Structure):
    _fields_ = (("header", _MsgHdr), ("length", ctypes.c_uint))


class MmsgBatch:
    """Pool of ``SLOTS`` slots, over ``recvmmsg`` and ``sendmmsg`` through ctypes.

    Attributes:
        pool: the slots, contiguous.
        slot_bytes: size of one slot; a longer frame arrives truncated.
    """

    def __init__(self, slot_bytes: int) -> None:
        library = ctypes.CDLL(None, use_errno=True)
        self._receive, self._send = library.recvmmsg, library.sendmmsg
        headers = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int)
        self._receive.argtypes, self._send.argtypes = (*headers, ctypes.c_void_p), headers
        self.slot_bytes = slot_bytes
        self._take_max = _most_at_once(slot_bytes)
        self.pool = bytearray(SLOTS * slot_bytes)
        self._head = bytearray(bytes(ETHER_BYTES - 2) + _ETHERTYPE)
        base = ctypes.addressof(ctypes.c_char.from_buffer(self.pool))
        head = ctypes.addressof(ctypes.c_char.from_buffer(self._head))

        self._in_vectors, self._in = (_IoVec * SLOTS)(), (_MmsgHdr * SLOTS)()
        self._out_vectors, self._out = (_IoVec * (2 * SLOTS))(), (_MmsgHdr * SLOTS)()
        self._own_vectors, self._own = (_IoVec * (2 * SLOTS))(), (_MmsgHdr * SLOTS)()
        tables = (self._in, self._in_vectors, 1), (self._out, self._out_vectors, 2), (self._own, self._own_vectors, 2)
        for slot in range(SLOTS):
            at = base + slot * slot_bytes
            self._in_vectors[slot] = _IoVec(at, slot_bytes)
            self._out_vectors[2 * slot] = self._own_vectors[2 * slot] = _IoVec(head, ETHER_BYTES)
            self._out_vectors[2 * slot + 1] = _IoVec(at + ETHER_BYTES, 0)
            for messages, vectors, each in tables:
                messages[slot].header.vectors = ctypes.addressof(vectors) + each * slot * ctypes.sizeof(_IoVec)
                messages[slot].header.vector_count = each
        self._own_at = ctypes.addressof(self._own)
        self._pointers = (ctypes.c_char_p * SLOTS)()
        self._addresses = memoryview(self._pointers).cast("B").cast("L")
        own_words = memoryview(self._own_vectors).cast("B").cast("L")
        self._own_addresses, self._own_sizes = own_words[2::4], own_words[3::4]
        self._in_at, self._out_at = ctypes.addressof(self._in), ctypes.addressof(self._out)

        # One slice reads all received lengths, one assignment sets all lengths to send.
        words = memoryview(self._in).cast("B").cast("I")
        self._taken = words[_MmsgHdr.length.offset // words.itemsize :: ctypes.sizeof(_MmsgHdr) // words.itemsize]
        self._sizes = memoryview(self._out_vectors).cast("B").cast("L")[3::4]  # size_t

    def receive(self, source: socket.socket) -> list[int]:
        """Fill slots with the frames that arrived, without waiting; return their bytes after each Ethernet header."""
        got = self._receive(source.fileno(), self._in_at, self._take_max, _DONTWAIT, None)
        if got <= 0:  # no frames, or the device went down: the link monitor reports it
            return []
        if got == 1:  # most calls, where messages are small
            self._sizes[0] = size = self._taken[0] - ETHER_BYTES
            return [size]
        sizes = [length - ETHER_BYTES for length in self._taken[:got].tolist()]
        self._sizes[:got] = memoryview(array("L", sizes))
        return sizes

    def receive_frames(self, source: socket.socket, port: int) -> Sequence[ReceivedFrame]:
        """Return the frames that arrived at a port's socket, without waiting."""
        sizes = self.receive(source)
        return burst.received(self.pool, self.slot_bytes, sizes, port, waited_s(source)) if sizes else []

    def send(self, sink: socket.socket, frames: Sequence[bytes], macs: bytes, drops: list[int]) -> int:
        """Send frames (from the GDP header on) from the caller's memory, to one pair of addresses.

        Returns how many were sent; the others are counted in ``drops``.
        """
        left = 0
        for first in range(0, len(frames), SLOTS):
            some = frames[first : first + SLOTS]
            count = len(some)
            self._pointers[:count] = list(some)
            self._own_addresses[:count] = self._addresses[:count]
            self._own_sizes[:count] = memoryview(array("L", map(len, some)))
            left += self._submit(sink.fileno(), self._own_at, 0, count, macs, drops)
        return left

    def forward(
        self, source: socket.socket, route: Route, other: Callable[[bytes], None], drops: list[int]
    ) -> tuple[int, int]:
        """Receive frames and forward them; return how many came, and how many left.

        Args:
            route: returns the hops, each a socket's descriptor and a pair of addresses, of frames that follow each
                other, by their key (``burst.runs``) and the bytes of the largest; none: each goes to ``other``.
            other: gets a frame, from its Ethernet header on, that is for the node itself or has no hops.
            drops: counts frames that are not sent.
        """
        sizes, sent, pool, step = self.receive(source), 0, self.pool, self.slot_bytes
        for first, count, key, largest in burst.runs(pool, step, sizes):
            hops, at = route(key, largest) if key else (), first * step
            if hops:
                hops_left = slice(at + ETHER_BYTES + HOPS_AT, at + count * step, step)
                pool[hops_left] = pool[hops_left].translate(_ONE_LESS)
            for fd, macs in hops:
                sent += self._submit(fd, self._out_at, first, count, macs, drops)
            for slot in range(first, first if hops else first + count):
                other(bytes(pool[slot * step : slot * step + ETHER_BYTES + sizes[slot]]))
        return len(sizes), sent

    def _submit(self, fd: int, table: int, first: int, count: int, macs: bytes, drops: list[int]) -> int:
        """Send ``count`` messages of the table of messages at an address."""
        self._head[: len(macs)] = macs
        end = first + count

        def send(at: int) -> int:
            sent: int = self._send(fd, table + at * ctypes.sizeof(_MmsgHdr), end - at, _DONTWAIT)
            return sent if sent > 0 else -ctypes.get_errno()

        return _send_all(send, first, end, drops)


class CompiledBatch:
    """As ``MmsgBatch``, over the burst core: frames stay where the kernel wrote them until they are read."""

    def __init__(self, slot_bytes: int) -> None:
        self.slot_bytes = slot_bytes
        self._receiver = burst.SYSTEM_CALLS.Receiver(slot_bytes, _most_at_once(slot_bytes))

    def receive_frames(self, source: socket.socket, port: int) -> Sequence[ReceivedFrame]:
        """Return the frames that arrived at a port's socket, as ``MmsgBatch``."""
        arrivals: Sequence[ReceivedFrame] = self._receiver.receive(source.fileno(), port)
        return arrivals

    def forward(
        self, source: socket.socket, route: Route, other: Callable[[bytes], None], drops: list[int]
    ) -> tuple[int, int]:
        """Receive frames and forward them; return how many came, and how many left, as ``MmsgBatch``."""
        done: tuple[int, int] = self._receiver.forward(source.fileno(), route, other, partial(_count_lost, drops))
        return done

    def send(self, sink: socket.socket, frames: Sequence[bytes], macs: bytes, drops: list[int]) -> int:
        """Send frames to one pair of addresses; return how many were sent, as ``MmsgBatch``."""
        send, head = burst.SYSTEM_CALLS.send, (macs + _ETHERTYPE)[:ETHER_BYTES]
        return _send_all(lambda at: send(sink.fileno(), frames, at, head), 0, len(frames), drops)


def put_one(sink: socket.socket, frame: bytes | bytearray, macs: bytes, drops: list[int]) -> int:
    """Send one frame (from the GDP header on), faster than as a batch; return how many were sent: 0 or 1."""
    try:
        sink.send(macs + _ETHERTYPE + frame)
    except OSError as error:
        drops[send_failure(error.errno or 0)[0]] += 1
        return 0
    return 1


Batch = MmsgBatch | CompiledBatch


def make_batch(slot_bytes: int) -> Batch:
    """Return a pool over the burst core in use."""
    return MmsgBatch(slot_bytes) if burst.SYSTEM_CALLS is None else CompiledBatch(slot_bytes)
