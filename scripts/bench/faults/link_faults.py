"""Link faults: frames lost, doubled and delayed between two namespaces, while the carrier of the link stays up.

I/O. Needs root. This also works on kernels without netem. A program at the ingress of the receiving device, before the
switch's own, sends each frame on a detour, which ends at the device again::

    frame -> device -> near end of a veth pair -> far end -> thread that loses, doubles, delays -> back, marked

A marked frame is passed on to the switch. Frames with different delays overtake each other. All of it depends on
descriptors of this process and ends with them.
Source: Linux, include/uapi/linux/bpf.h (``BPF_TCX_INGRESS``, ``BPF_F_BEFORE``, ``bpf_redirect``).
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
from functools import partial
from itertools import count
from typing import Final

from pyroute2 import IPRoute

from gdp.closing import ClosedOnExit
from gdp.frame.codec import ETHERTYPE
from gdp.ports.kernel.assembler import Assembler, Reg
from gdp.ports.kernel.syscall import Command, bpf, load_program
from gdp.ports.sockets import large_buffers
from lab.namespaces import Namespaces

_TCX_INGRESS: Final = 46
_BEFORE: Final = 1 << 3  # BPF_F_BEFORE, with no program named: before all
_INGRESS: Final = 1  # BPF_F_INGRESS
_NEXT: Final = -1  # TCX_NEXT
_MARK_AT: Final = 8  # struct __sk_buff
_MARK: Final = 0x67647066
_REDIRECT: Final = 23  # helper
_LICENCE: Final = b"Dual MIT/GPL"
_FRAME_BYTES: Final = 1 << 16
_MTU_BYTES: Final = 9_216


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """Chances, 0 to 1, of each received frame; ``delay_s``: upper bound of the random delay of a delayed frame."""

    lost: float = 0.0
    doubled: float = 0.0
    delayed: float = 0.0
    delay_s: float = 0.02


class LinkFaults(ClosedOnExit):
    """The faults of the links between these namespaces; a context manager that ends them all."""

    def __init__(self, spaces: Namespaces) -> None:
        self._spaces = spaces
        self._detours: dict[tuple[str, str], _Detour] = {}
        self._numbers = count()

    def set(self, a: str, b: str, faults: FrameFaults) -> None:
        """Apply faults to the frames of a link, both ways, from now on. Raises ``LocalError``: the kernel refuses."""
        for own, other in ((a, b), (b, a)):
            if detour := self._detours.get((own, other)):
                detour.faults = faults
            else:
                made = self._spaces[own].inside(partial(_Detour, other, next(self._numbers), faults))
                self._detours[own, other] = made

    def clear(self, a: str, b: str) -> None:
        """Remove the faults of a link; harmless where it has none. Frames that are delayed are lost."""
        for own, other in ((a, b), (b, a)):
            if detour := self._detours.pop((own, other), None):
                self._spaces[own].inside(detour.close)

    def close(self) -> None:
        """Remove all faults."""
        for ends in list(self._detours):
            with contextlib.suppress(OSError):  # the namespace was removed first, with its devices
                self.clear(*ends)


class _Detour:
    """Detour of the frames of one device; made and closed inside its namespace."""

    def __init__(self, ifname: str, number: int, faults: FrameFaults) -> None:
        self.faults = faults
        near, far = f"late{number}a", f"late{number}b"
        with IPRoute() as here:
            (ifindex,) = here.link_lookup(ifname=ifname)
            here.link("add", kind="veth", ifname=near, peer={"ifname": far})
            (self._near,) = here.link_lookup(ifname=near)
            for name in (near, far):
                here.link("set", index=here.link_lookup(ifname=name)[0], state="up", mtu=_MTU_BYTES)
        self._far = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        large_buffers(self._far)
        self._far.bind((far, ETHERTYPE))
        self._descriptors = [*_attach(_returning(ifindex), self._near), *_attach(_leaving(self._near), ifindex)]
        self._thread = threading.Thread(target=self._run, name=f"detour of {ifname}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Lead frames past the detour again, and remove it."""
        for descriptor in self._descriptors:
            os.close(descriptor)
        with IPRoute() as here:
            here.link("del", index=self._near)  # the thread ends with its device
        self._thread.join()

    def _run(self) -> None:
        waiting: list[tuple[float, int, bytes]] = []  # when due, order of arrival, frame
        order = count()
        with self._far, contextlib.suppress(OSError):  # the device is gone
            while True:
                wait_s = max(waiting[0][0] - time.monotonic(), 0.0) if waiting else None
                if select.select([self._far], [], [], wait_s)[0]:
                    frame, faults = self._far.recv(_FRAME_BYTES), self.faults
                    if random.random() >= faults.lost:
                        copies = 2 if random.random() < faults.doubled else 1
                        for _ in range(copies):
                            delay_s = random.random() * faults.delay_s if random.random() < faults.delayed else 0.0
                            heapq.heappush(waiting, (time.monotonic() + delay_s, next(order), frame))
                while waiting and waiting[0][0] <= time.monotonic():
                    self._far.send(heapq.heappop(waiting)[2])


def _leaving(near: int) -> bytes:
    """Return the program at a device: a frame that has not come back leaves on the detour."""
    code = Assembler()
    code.move(Reg.R6, Reg.R1)
    code.load(Reg.R1, Reg.R6, _MARK_AT, 4)
    code.jump_if(Reg.R1, "==", _MARK, "returned")
    code.move(Reg.R1, near)
    code.move(Reg.R2, 0)
    code.call(_REDIRECT)
    code.leave()
    code.label("returned")
    _mark(code, 0)
    code.leave(_NEXT)
    return code.assemble()


def _returning(ifindex: int) -> bytes:
    """Return the program at the near end of a detour: a frame that comes back arrives at the device once more."""
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


def _attach(code: bytes, ifindex: int) -> tuple[int, int]:
    """Attach a program to a device, before others; return the descriptors that keep it there."""
    program = load_program(code, "detour", _LICENCE)
    attributes = bytearray(struct.pack("=IIIIIIQ16x", program, ifindex, _TCX_INGRESS, _BEFORE, 0, 0, 0))
    return bpf(Command.LINK_CREATE, attributes, f"attach before others to device {ifindex}"), program
