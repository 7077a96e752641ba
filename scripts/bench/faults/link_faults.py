"""Link faults: frames lost and doubled between two namespaces, while the carrier of the link stays up.

I/O. Needs root. This also works on kernels without netem. A program at the ingress of the receiving device, before the
switch's own, draws a number for each fault, and loses the frame, doubles it or passes it on. The second one of a pair
carries a mark. All of it depends on descriptors of this process and ends with them.
Source: Linux, include/uapi/linux/bpf.h (``BPF_TCX_INGRESS``, ``BPF_F_BEFORE``, ``bpf_clone_redirect``).
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pyroute2 import IPRoute

from gdp.host import netns_files
from gdp.ports.kernel.assembler import Assembler, Reg
from gdp.ports.kernel.maps import KernelMap, MapKind
from gdp.ports.kernel.syscall import Command, bpf, load_program

_TCX_INGRESS: Final = 46
_BEFORE: Final = 1 << 3  # BPF_F_BEFORE, with no program named: before all
_INGRESS: Final = 1  # BPF_F_INGRESS
_NEXT, _DROP = -1, 2  # TCX_NEXT, TCX_DROP
_MARK_AT, _IFINDEX_AT = 8, 40  # struct __sk_buff
_MARK: Final = 0x67647066
_LOOKUP, _RANDOM, _CLONE = 1, 7, 13  # helpers
_SETTINGS: Final = struct.Struct("=QQ")  # lost, doubled of 2**32
_WHOLE: Final = 1 << 32
_FIRST: Final = bytes(4)
_LICENCE: Final = b"Dual MIT/GPL"


@dataclass(frozen=True, slots=True)
class FrameFaults:
    """Chances, 0 to 1, of each received frame."""

    lost: float = 0.0
    doubled: float = 0.0


class LinkFaults:
    """The faults of many devices; a context manager that ends them all."""

    def __init__(self) -> None:
        self._ends: dict[tuple[Path, str], _End] = {}

    def __enter__(self) -> LinkFaults:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def set(self, namespace: Path, ifname: str, faults: FrameFaults) -> None:
        """Apply faults to frames that a device receives, from now on.

        Raises ``LocalError``: the kernel refuses. Raises ``OSError``: no such namespace.
        """
        if (namespace, ifname) not in self._ends:
            self._ends[namespace, ifname] = netns_files.inside(namespace, lambda: _End(ifname))
        self._ends[namespace, ifname].write(faults)

    def clear(self, namespace: Path, ifname: str) -> None:
        """Remove the faults of a device; harmless where it has none."""
        if (end := self._ends.pop((namespace, ifname), None)) is not None:
            end.close()

    def close(self) -> None:
        """Remove all faults."""
        while self._ends:
            self._ends.popitem()[1].close()


class _End:
    """Program at one device; made inside its namespace."""

    def __init__(self, ifname: str) -> None:
        with IPRoute() as here:
            (ifindex,) = here.link_lookup(ifname=ifname)
        self._settings = KernelMap(MapKind.ARRAY, 4, _SETTINGS.size, 1, "faults")
        self._program = load_program(_faulty(self._settings.fd), "faulty", _LICENCE)
        self._link = _attach_first(self._program, ifindex)

    def write(self, faults: FrameFaults) -> None:
        """Apply these chances from the next frame on."""
        self._settings.put(_FIRST, _SETTINGS.pack(*(round(share * _WHOLE) for share in (faults.lost, faults.doubled))))

    def close(self) -> None:
        os.close(self._link)
        os.close(self._program)
        self._settings.close()


def _faulty(settings: int) -> bytes:
    """Return the program at a device. R6: the frame; R7: the chances."""
    code = Assembler()
    code.move(Reg.R6, Reg.R1)
    code.load(Reg.R1, Reg.R6, _MARK_AT, 4)
    code.jump_if(Reg.R1, "==", _MARK, "second")
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
    code.jump_if(Reg.R0, ">=", Reg.R8, "next")
    _mark(code, _MARK)
    code.move(Reg.R1, Reg.R6)
    code.load(Reg.R2, Reg.R6, _IFINDEX_AT, 4)
    code.move(Reg.R3, _INGRESS)
    code.call(_CLONE)
    code.label("second")
    _mark(code, 0)
    code.label("next")
    code.leave(_NEXT)
    code.label("drop")
    code.leave(_DROP)
    return code.assemble()


def _mark(code: Assembler, value: int) -> None:
    code.move(Reg.R1, value)
    code.store(Reg.R6, _MARK_AT, Reg.R1, 4)


def _attach_first(program: int, ifindex: int) -> int:
    attributes = bytearray(struct.pack("=IIIIIIQ16x", program, ifindex, _TCX_INGRESS, _BEFORE, 0, 0, 0))
    return bpf(Command.LINK_CREATE, attributes, f"attach before others to device {ifindex}")
