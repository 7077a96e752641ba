"""bpf(2) through ctypes: the one place that speaks to the kernel about programs, maps and links.

Place: I/O; keeps nothing. File descriptors come and go as plain numbers, opened close-on-exec by the kernel.
Source: bpf(2); Linux, include/uapi/linux/bpf.h, ``union bpf_attr``. What is left out of an attribute is zero.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gdp.errors import LocalError

__all__ = [
    "BpfError",
    "Command",
    "LoadRefusedError",
    "Run",
    "address",
    "attached",
    "bpf",
    "create_link",
    "link_program",
    "load_program",
    "name_of",
    "objects",
    "program_id",
    "program_name",
    "run",
]

NAME_MAX: Final = 15  # BPF_OBJ_NAME_LEN - 1
_LOG_BYTES: Final = 1 << 20
_SCHED_CLS: Final = 3  # BPF_PROG_TYPE_SCHED_CLS
_INFO_BYTES: Final = 256
_ATTACHED_MAX: Final = 64  # BPF_MPROG_MAX: more are never at one hook
_SKB_BYTES: Final = 512  # more than struct __sk_buff has
_PRIORITY_AT: Final = 32
_NUMBERS: Final = {  # of the call itself; where Python is 32-bit, under the machine that it was built for
    "x86_64": 321,
    "aarch64": 280,
    "riscv64": 280,
    "loongarch64": 280,
    "armv6l": 386,
    "armv7l": 386,
    "i686": 357,
    "ppc64le": 361,
    "s390x": 351,
}
_NARROW: Final = {"x86_64": "i686", "aarch64": "armv7l", "armv8l": "armv7l"}


class Command(IntEnum):
    """``enum bpf_cmd``, as far as it is used."""

    MAP_CREATE = 0
    MAP_LOOKUP_ELEM = 1
    MAP_UPDATE_ELEM = 2
    MAP_DELETE_ELEM = 3
    PROG_LOAD = 5
    PROG_TEST_RUN = 10
    PROG_GET_NEXT_ID = 11
    PROG_GET_FD_BY_ID = 13
    OBJ_GET_INFO_BY_FD = 15
    PROG_QUERY = 16
    MAP_LOOKUP_BATCH = 24
    MAP_UPDATE_BATCH = 26
    MAP_DELETE_BATCH = 27
    LINK_CREATE = 28
    LINK_GET_FD_BY_ID = 30
    LINK_GET_NEXT_ID = 31


class BpfError(LocalError):
    """The kernel refused.

    Attributes:
        number: its errno.
    """

    def __init__(self, number: int, tried: str) -> None:
        name = errno.errorcode.get(number, str(number))
        hint = " (it needs CAP_BPF and CAP_NET_ADMIN, or root)" if number in (errno.EPERM, errno.EACCES) else ""
        super().__init__(f"{tried}: {name}, {os.strerror(number)}{hint}")
        self.number = number


class LoadRefusedError(BpfError):
    """The verifier does not let a program in; its log is part of the text.

    Attributes:
        log: what the verifier said; empty when it was not even asked.
    """

    def __init__(self, number: int, tried: str, log: str) -> None:
        super().__init__(number, tried)
        self.log = log

    def __str__(self) -> str:
        return f"{super().__str__()}\n{self.log}" if self.log else super().__str__()


@dataclass(frozen=True, slots=True)
class Run:
    """What a program made of one frame.

    Attributes:
        each_ns: mean of the repeats; each is given the frame that the one before it left.
        priority: that the frame leaves with.
    """

    ack: int
    frame: bytes
    each_ns: int
    priority: int


_libc = ctypes.CDLL(None, use_errno=True)
_libc.syscall.restype = ctypes.c_long
_libc.syscall.argtypes = (ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_uint)


def _number() -> int:
    machine = platform.machine()
    if sys.maxsize < 1 << 32:
        machine = _NARROW.get(machine, machine)
    number = _NUMBERS.get(machine)
    if number is None:
        raise LocalError(f"bpf(2) has no known number on {machine}")
    return number


def address(buffer: bytes | bytearray) -> int:
    """Return where a buffer lies; valid for as long as the caller keeps the buffer and its size."""
    if isinstance(buffer, bytearray):
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))
    return ctypes.cast(ctypes.c_char_p(buffer), ctypes.c_void_p).value or 0


def bpf(command: Command, attributes: bytearray, tried: str) -> int:
    """Make the call. The kernel may write into ``attributes``.

    Args:
        tried: what for, in words, for the error.

    Raises:
        BpfError: refused.
        LocalError: this machine is unknown.
    """
    result = _libc.syscall(_number(), command, address(attributes), len(attributes))
    if result < 0:
        raise BpfError(ctypes.get_errno(), tried)
    return int(result)


def load_program(code: bytes, name: str, licence: bytes) -> int:
    """Load a traffic-control program; return its file descriptor.

    Raises:
        LoadRefusedError: with the verifier's log, if it got that far.
    """
    text = licence + b"\0"
    log = bytearray(_LOG_BYTES)

    def attributes(level: int) -> bytearray:
        place = (len(log), address(log)) if level else (0, 0)
        head = struct.pack("=IIQQIIQ", _SCHED_CLS, len(code) // 8, address(code), address(text), level, *place)
        return bytearray(head + struct.pack("=II16s16x", 0, 0, name.encode()[:NAME_MAX]))

    tried = f"load the program {name}"
    try:
        return bpf(Command.PROG_LOAD, attributes(0), tried)
    except BpfError as refused:
        try:  # once more, now for its reasons: a log costs time, so it is not kept for what succeeds
            return bpf(Command.PROG_LOAD, attributes(1), tried)
        except BpfError:
            raise LoadRefusedError(refused.number, tried, log.partition(b"\0")[0].decode(errors="replace")) from refused


def create_link(program: int, ifindex: int, attach_type: int) -> int:
    """Attach a program to a device, behind those that are there; closing the returned descriptor detaches it.

    Raises:
        BpfError: refused.
    """
    attributes = bytearray(struct.pack("=IIII32x", program, ifindex, attach_type, 0))
    return bpf(Command.LINK_CREATE, attributes, f"attach to device {ifindex}")


def attached(ifindex: int, attach_type: int) -> list[int]:
    """Return the programs that stand at one hook of a device, by id.

    Raises:
        BpfError: EINVAL: this kernel does not know that hook.
    """
    ids = bytearray(4 * _ATTACHED_MAX)
    attributes = bytearray(struct.pack("=IIIIQI36x", ifindex, attach_type, 0, 0, address(ids), _ATTACHED_MAX))
    bpf(Command.PROG_QUERY, attributes, f"ask for the programs of device {ifindex}")
    count = struct.unpack_from("=I", attributes, 24)[0]
    return [*struct.unpack_from(f"={count}I", ids)]


def name_of(program: int) -> str | None:
    """Return the name of a program by id; None where it is gone.

    Raises:
        BpfError: EPERM: it takes CAP_SYS_ADMIN to open what others loaded.
    """
    try:
        opened = bpf(Command.PROG_GET_FD_BY_ID, bytearray(struct.pack("=I12x", program)), "open what is loaded")
    except BpfError as error:
        if error.number == errno.ENOENT:
            return None
        raise
    try:
        return program_name(opened)
    finally:
        os.close(opened)


def run(program: int, frame: bytes, repeat: int = 1) -> Run:
    """Give a frame to a program as if the loopback device had received it.

    Raises:
        BpfError: shorter than an Ethernet header, longer than a page takes, or not allowed.
    """
    out, data, skb = bytearray(len(frame) + 256), bytearray(frame), bytearray(_SKB_BYTES)
    frames = struct.pack("=IIIIQQI", program, 0, len(data), len(out), address(data), address(out), repeat)
    attributes = bytearray(frames + struct.pack("=IIIQQ16x", 0, 0, len(skb), 0, address(skb)))
    bpf(Command.PROG_TEST_RUN, attributes, "run the program")
    _, ack, _, size, _, _, _, each_ns = struct.unpack_from("=IiIIQQII", attributes)
    return Run(ack, bytes(out[:size]), each_ns, struct.unpack_from("=I", skb, _PRIORITY_AT)[0])


def objects(next_id: Command, open_by_id: Command) -> Iterator[int]:
    """Open every program (or link) that there is, one after the other; each is closed before the next.

    Raises:
        BpfError: not allowed.
    """
    at = 0
    while True:
        attributes = bytearray(struct.pack("=II8x", at, 0))
        try:
            bpf(next_id, attributes, "list what is loaded")
        except BpfError as error:
            if error.number == errno.ENOENT:
                return
            raise
        at = struct.unpack_from("=II", attributes)[1]
        try:
            opened = bpf(open_by_id, bytearray(struct.pack("=I12x", at)), "open what is loaded")
        except BpfError as error:
            if error.number == errno.ENOENT:  # gone meanwhile
                continue
            raise
        try:
            yield opened
        finally:
            os.close(opened)


def program_name(program: int) -> str:
    """Return the name that a program was loaded under.

    Raises:
        BpfError: not a program.
    """
    return _info(program)[64:80].partition(b"\0")[0].decode(errors="replace")


def program_id(program: int) -> int:
    """Return the number that a program has for as long as it is there.

    Raises:
        BpfError: not a program.
    """
    return int(struct.unpack_from("=II", _info(program))[1])


def link_program(link: int) -> int:
    """Return the id of a link's program.

    Raises:
        BpfError: not a link.
    """
    return int(struct.unpack_from("=III", _info(link))[2])


def _info(opened: int) -> bytes:
    info = bytearray(_INFO_BYTES)
    bpf(Command.OBJ_GET_INFO_BY_FD, bytearray(struct.pack("=IIQ", opened, len(info), address(info))), "ask for details")
    return bytes(info)
