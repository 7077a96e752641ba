"""Link faults: frames lost, doubled and delayed between two namespaces, while the carrier of the link stays up.

I/O. Needs root. This also works on kernels without netem. A program at the ingress of the receiving
device, before the switch's own, draws a number for each fault::

    frame -> lose it | double it | send it through the delay line | pass it on to the switch

The delay line is a veth pair in the same namespace, whose other end a thread of this process reads. It returns each
frame after a random time, so frames overtake each other. A returned frame carries a mark and is passed on.
All of it depends on descriptors of this process and ends with them.
Source: Linux, include/uapi/linux/bpf.h (``BPF_TCX_INGRESS``, ``BPF_F_BEFORE``, ``bpf_clone_redirect``).
"""

from __future__ import annotations

import contextlib
import heapq
import os
import random
import select
import socket
import struct
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pyroute2 import IPRoute

from gdp.closing import ClosedOnExit
from gdp.frame.codec import ETHERTYPE
from gdp.host import netns_files
from gdp.ports.kernel.assembler import Assembler, Reg
from gdp.ports.kernel.maps import KernelMap, MapKind
from gdp.ports.kernel.syscall import Command, bpf, load_program
from gdp.ports.sockets import large_buffers

_TCX_INGRESS: Final = 46
_BEFORE: Final = 1 << 3  # BPF_F_BEFORE, with no program named: before all
_INGRESS: Final = 1  # BPF_F_INGRESS
_NEXT, _DROP = -1, 2  # TCX_NEXT, TCX_DROP
_MARK_AT, _IFINDEX_AT = 8, 40  # struct __sk_buff
_MARK: Final = 0x67647066
_LOOKUP, _RANDOM, _CLONE, _REDIRECT = 1, 7, 13, 23  # helpers
_SETTINGS: Final = struct.Struct("=QQQQ")  # lost, doubled, delayed of 2**32; ifindex of the delay line
_WHOLE: Final = 1 << 32
_FIRST: Final = bytes(4)
_LICENCE: Final = b"Dual MIT/GPL"
_FRAME_BYTES: Final = 1 << 16
_BATCH: Final = 64


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """Chances, 0 to 1, of each received frame; ``delay_s``: upper bound of the random delay of a delayed frame."""

    lost: float = 0.0
    doubled: float = 0.0
    delayed: float = 0.0
    delay_s: float = 0.02


class LinkFaults(ClosedOnExit):
    """The faults of many devices; a context manager that ends them all."""

    def __init__(self) -> None:
        self._ends: dict[tuple[Path, str], _End] = {}
        self._line: _DelayLine | None = None
        self._made = 0

    def set(self, namespace: Path, ifname: str, faults: FrameFaults) -> None:
        """Apply faults to frames that a device receives, from now on.

        Raises ``LocalError``: the kernel refuses. Raises ``OSError``: no such namespace.
        """
        end = self._ends.get((namespace, ifname))
        if end is None:
            self._made += 1
            made = self._made
            end = self._ends[namespace, ifname] = netns_files.inside(namespace, lambda: _End(ifname, made))
        line = 0
        if faults.delayed:
            self._line = self._line or _DelayLine()
            line = netns_files.inside(namespace, lambda: end.open_line(self._line, faults.delay_s))  # type: ignore[arg-type]
        end.write(faults, line)

    def clear(self, namespace: Path, ifname: str) -> None:
        """Remove the faults of a device; harmless where it has none."""
        end = self._ends.pop((namespace, ifname), None)
        if end is not None:
            self._close(namespace, end)

    def close(self) -> None:
        """Remove all faults."""
        while self._ends:
            (namespace, _), end = self._ends.popitem()
            with contextlib.suppress(OSError):  # the namespace was removed first, with its devices
                self._close(namespace, end)
        if self._line is not None:
            self._line.close()
            self._line = None

    def _close(self, namespace: Path, end: _End) -> None:
        line = self._line
        netns_files.inside(namespace, lambda: end.close(line))


class _End:
    """Program at one device; made and closed inside its namespace."""

    def __init__(self, ifname: str, number: int) -> None:
        self._names = f"late{number}a", f"late{number}b"
        with IPRoute() as here:
            (self._ifindex,) = here.link_lookup(ifname=ifname)
        self._settings = KernelMap(MapKind.ARRAY, 4, _SETTINGS.size, 1, "faults")
        self._program = load_program(_faulty(self._settings.fd), "faulty", _LICENCE)
        self._link = _attach_first(self._program, self._ifindex)
        self._back = self._back_link = -1
        self._line_ifindex = 0
        self._far: socket.socket | None = None

    def write(self, faults: FrameFaults, line: int) -> None:
        """Apply these chances from the next frame on."""
        chances = (round(share * _WHOLE) for share in (faults.lost, faults.doubled, faults.delayed))
        self._settings.put(_FIRST, _SETTINGS.pack(*chances, line))

    def open_line(self, line: _DelayLine, delay_s: float) -> int:
        """Make the veth pair of the delay line, once; return the index of its near end."""
        near, far = self._names
        if self._far is None:
            with IPRoute() as here:
                here.link("add", kind="veth", ifname=near, peer={"ifname": far})
                (self._line_ifindex,) = here.link_lookup(ifname=near)
                for name in (near, far):
                    here.link("set", index=here.link_lookup(ifname=name)[0], state="up", mtu=9_216)
            self._back = load_program(_returning(self._ifindex), "late", _LICENCE)
            self._back_link = _attach_first(self._back, self._line_ifindex)
            self._far = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
            large_buffers(self._far)
            self._far.setblocking(False)
            self._far.bind((far, ETHERTYPE))
        line.add(self._far, delay_s)
        return self._line_ifindex

    def close(self, line: _DelayLine | None) -> None:
        for descriptor in (self._link, self._program, self._back_link, self._back):
            if descriptor >= 0:
                os.close(descriptor)
        self._settings.close()
        if self._far is not None and line is not None:
            line.remove(self._far)
            self._far.close()
            with IPRoute() as here:
                here.link("del", index=self._line_ifindex)


class _DelayLine:
    """Thread that returns frames late."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._sockets: dict[int, tuple[socket.socket, float]] = {}
        self._waiting: list[tuple[float, int, int, bytes]] = []  # when due, order of arrival, descriptor, frame
        self._count = 0
        self._is_over = False
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="delay line", daemon=True)
        self._thread.start()

    def add(self, far: socket.socket, delay_s: float) -> None:
        """Delay the frames of this socket."""
        with self._lock:
            if far.fileno() not in self._sockets:
                self._epoll.register(far.fileno(), select.EPOLLIN)
            self._sockets[far.fileno()] = far, delay_s

    def remove(self, far: socket.socket) -> None:
        """Stop; pending frames are lost."""
        with self._lock:
            if self._sockets.pop(far.fileno(), None) is not None:
                self._epoll.unregister(far.fileno())

    def close(self) -> None:
        self._is_over = True
        self._thread.join()
        self._epoll.close()

    def _run(self) -> None:
        while not self._is_over:
            due_s = self._waiting[0][0] - time.monotonic() if self._waiting else 0.1
            events = self._epoll.poll(min(max(due_s, 0.0), 0.1))
            with self._lock:
                for descriptor, _ in events:
                    self._take(descriptor)
                now_s = time.monotonic()
                while self._waiting and self._waiting[0][0] <= now_s:
                    _, _, descriptor, frame = heapq.heappop(self._waiting)
                    if descriptor in self._sockets:
                        with contextlib.suppress(BlockingIOError):  # its queue is full: one more frame lost here
                            self._sockets[descriptor][0].send(frame)

    def _take(self, descriptor: int) -> None:
        if descriptor not in self._sockets:
            return
        far, delay_s = self._sockets[descriptor]
        for _ in range(_BATCH):
            try:
                frame, address = far.recvfrom(_FRAME_BYTES)
            except BlockingIOError:
                return
            if address[2] != socket.PACKET_OUTGOING:
                self._count += 1
                due_s = time.monotonic() + random.random() * delay_s
                heapq.heappush(self._waiting, (due_s, self._count, descriptor, frame))


def _faulty(settings: int) -> bytes:
    """Return the program at a device. R6: the frame; R7: the chances."""
    code = Assembler()
    code.move(Reg.R6, Reg.R1)
    code.load(Reg.R1, Reg.R6, _MARK_AT, 4)
    code.jump_if(Reg.R1, "==", _MARK, "returned")
    code.store(Reg.R10, -4, 0, 4)
    code.load_map(Reg.R1, settings)
    code.move(Reg.R2, Reg.R10)
    code.add(Reg.R2, -4)
    code.call(_LOOKUP)
    code.jump_if(Reg.R0, "==", 0, "next")
    code.move(Reg.R7, Reg.R0)
    code.call(_RANDOM)
    code.load(Reg.R8, Reg.R7, 0, 8)
    code.jump_if(Reg.R0, "<", Reg.R8, "drop")
    code.call(_RANDOM)
    code.load(Reg.R8, Reg.R7, 8, 8)
    code.jump_if(Reg.R0, ">=", Reg.R8, "single")
    _mark(code, _MARK)
    code.move(Reg.R1, Reg.R6)
    code.load(Reg.R2, Reg.R6, _IFINDEX_AT, 4)
    code.move(Reg.R3, _INGRESS)
    code.call(_CLONE)
    _mark(code, 0)
    code.label("single")
    code.call(_RANDOM)
    code.load(Reg.R8, Reg.R7, 16, 8)
    code.jump_if(Reg.R0, ">=", Reg.R8, "next")
    code.load(Reg.R1, Reg.R7, 24, 8)
    code.move(Reg.R2, 0)
    code.call(_REDIRECT)
    code.leave()
    code.label("returned")
    _mark(code, 0)
    code.label("next")
    code.leave(_NEXT)
    code.label("drop")
    code.leave(_DROP)
    return code.assemble()


def _returning(ifindex: int) -> bytes:
    """Return the program at the near end of a delay line: a returned frame arrives at the device once more."""
    code = Assembler()
    code.move(Reg.R6, Reg.R1)
    _mark(code, _MARK)
    code.move(Reg.R1, ifindex)
    code.move(Reg.R2, _INGRESS)
    code.call(_REDIRECT)
    code.leave()
    return code.assemble()


def _mark(code: Assembler, value: int) -> None:
    code.move(Reg.R1, value)
    code.store(Reg.R6, _MARK_AT, Reg.R1, 4)


def _attach_first(program: int, ifindex: int) -> int:
    attributes = bytearray(struct.pack("=IIIIIIQ16x", program, ifindex, _TCX_INGRESS, _BEFORE, 0, 0, 0))
    return bpf(Command.LINK_CREATE, attributes, f"attach before others to device {ifindex}")
