"""bpf(2) system call through ctypes: the only module that calls the kernel for programs, maps and links.

I/O; it keeps no state. File descriptors are plain numbers, which the kernel opens close-on-exec. A call that the kernel
refuses raises ``BpfError``: the right is missing, or a descriptor is of another kind.
Source: bpf(2); Linux, include/uapi/linux/bpf.h, ``union bpf_attr``. Omitted fields of an attribute are zero.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from gdp.errors import LocalError

NAME_MAX: Final = 15  # BPF_OBJ_NAME_LEN - 1
_LOG_BYTES: Final = 1 << 20
_SCHED_CLS: Final = 3  # BPF_PROG_TYPE_SCHED_CLS
_INFO_BYTES: Final = 256
_ATTACHED_MAX: Final = 64  # BPF_MPROG_MAX: the most programs at one hook
_SKB_BYTES: Final = 512  # more than the size of struct __sk_buff
_PRIORITY_AT: Final = 32
BATCH: Final = struct.Struct("=QQQQIIQQ")  # of map elements: the count is the fifth
_REPEAT_AT: Final = 8  # in words
_NUMBERS: Final = {  # of the call itself; a 32-bit Python looks up the machine that it was built for
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
    """``enum bpf_cmd``, as far as it is used here."""

    MAP_CREATE = 0
    MAP_LOOKUP_ELEM = 1
    MAP_UPDATE_ELEM = 2
    MAP_DELETE_ELEM = 3
    PROG_LOAD = 5
    PROG_TEST_RUN = 10
    PROG_GET_FD_BY_ID = 13
    OBJ_GET_INFO_BY_FD = 15
    PROG_QUERY = 16
    MAP_LOOKUP_BATCH = 24
    MAP_UPDATE_BATCH = 26
    MAP_DELETE_BATCH = 27
    LINK_CREATE = 28


class BpfError(LocalError):
    """The kernel refused a call."""

    def __init__(self, number: int, tried: str) -> None:
        name = errno.errorcode.get(number, str(number))
        hint = " (it needs CAP_BPF and CAP_NET_ADMIN, or root)" if number in (errno.EPERM, errno.EACCES) else ""
        super().__init__(f"{tried}: {name}, {os.strerror(number)}{hint}")
        self.number = number


class LoadRefusedError(BpfError):
    """The verifier rejected a program; its log is part of the text.

    Attributes:
        log: the verifier's log; empty if the kernel refused before verification.
    """

    def __init__(self, number: int, tried: str, log: str) -> None:
        super().__init__(number, tried)
        self.log = log

    def __str__(self) -> str:
        return f"{super().__str__()}\n{self.log}" if self.log else super().__str__()


@dataclass(frozen=True, slots=True)
class Run:
    """The result of a program on one frame.

    Attributes:
        each_ns: mean time of the repeats; each repeat gets the frame that the previous one left.
        priority: priority of the frame after the program.
    """

    retval: int
    frame: bytes
    each_ns: int
    priority: int


TCX_INGRESS: Final = 46  # enum bpf_attach_type

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
    """Return the address of a buffer; valid while the caller keeps the buffer and its size."""
    if isinstance(buffer, bytearray):
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))
    return ctypes.cast(ctypes.c_char_p(buffer), ctypes.c_void_p).value or 0


def bpf(command: int, attributes: bytearray, tried: str) -> int:
    """Make the call. The kernel may write into ``attributes``.

    Args:
        tried: purpose of the call, in words, for the error.

    Raises:
        BpfError: the kernel refuses it.
        LocalError: the machine type is unknown.
    """
    result = _libc.syscall(_number(), command, address(attributes), len(attributes))
    if result < 0:
        raise BpfError(ctypes.get_errno(), tried)
    return int(result)


def load_program(code: bytes, name: str, licence: bytes) -> int:
    """Load a traffic-control program; return its file descriptor.

    Raises:
        LoadRefusedError: with the verifier's log if the verifier ran.
    """
    text = licence + b"\0"
    log = bytearray(_LOG_BYTES)

    def attributes(level: int) -> bytearray:
        """Return the attribute bytes of the call; ``level``: log level, 0 for no log."""
        place = (len(log), address(log)) if level else (0, 0)
        head = struct.pack("=IIQQIIQ", _SCHED_CLS, len(code) // 8, address(code), address(text), level, *place)
        return bytearray(head + struct.pack("=II16s16x", 0, 0, name.encode()[:NAME_MAX]))

    tried = f"load the program {name}"
    try:
        return bpf(Command.PROG_LOAD, attributes(0), tried)
    except BpfError as refused:
        try:  # again, with a log, which costs time and is not needed on success
            return bpf(Command.PROG_LOAD, attributes(1), tried)
        except BpfError:
            raise LoadRefusedError(refused.number, tried, log.partition(b"\0")[0].decode(errors="replace")) from refused


def create_link(program: int, ifindex: int, attach_type: int) -> int:
    """Attach a program to a device after the present ones; closing the returned descriptor detaches it."""
    attributes = bytearray(struct.pack("=IIII32x", program, ifindex, attach_type, 0))
    return bpf(Command.LINK_CREATE, attributes, f"attach to device {ifindex}")


def attached(ifindex: int, attach_type: int) -> list[int]:
    """Return the ids of the programs at one hook of a device.

    Raises:
        BpfError: EINVAL if this kernel does not know the hook.
    """
    ids = bytearray(4 * _ATTACHED_MAX)
    attributes = bytearray(struct.pack("=IIIIQI36x", ifindex, attach_type, 0, 0, address(ids), _ATTACHED_MAX))
    bpf(Command.PROG_QUERY, attributes, f"ask for the programs of device {ifindex}")
    count = struct.unpack_from("=I", attributes, 24)[0]
    return [*struct.unpack_from(f"={count}I", ids)]


def name_of(program: int) -> str | None:
    """Return the name of a program by id; None if it is gone.

    Raises:
        BpfError: EPERM, because opening a program of another owner takes CAP_SYS_ADMIN.
    """
    try:
        opened = bpf(Command.PROG_GET_FD_BY_ID, bytearray(struct.pack("=I12x", program)), "open what is loaded")
    except BpfError as error:
        if error.number == errno.ENOENT:
            return None
        raise
    try:
        return info_of(opened)[64:80].partition(b"\0")[0].decode(errors="replace")
    finally:
        os.close(opened)


def run(program: int, frame: bytes, repeat: int = 1) -> Run:
    """Run a program on a frame as if the loopback device had received it.

    Raises:
        BpfError: the frame is shorter than an Ethernet header or larger than a page holds, or the right is missing.
    """
    out, data, skb = bytearray(len(frame) + 256), bytearray(frame), bytearray(_SKB_BYTES)
    frames = struct.pack("=IIIIQQI", program, 0, len(data), len(out), address(data), address(out), repeat)
    attributes = bytearray(frames + struct.pack("=IIIQQ16x", 0, 0, len(skb), 0, address(skb)))
    bpf(Command.PROG_TEST_RUN, attributes, "run the program")
    _, retval, _, size, _, _, _, each_ns = struct.unpack_from("=IiIIQQII", attributes)
    return Run(retval, bytes(out[:size]), each_ns, struct.unpack_from("=I", skb, _PRIORITY_AT)[0])


class PreparedRun:
    """Runs of a program on the same frame, again and again; each run costs a few microseconds."""

    def __init__(self, program: int, frame: bytes) -> None:
        self._frame = bytearray(frame)
        self._attributes = bytearray(struct.pack("=IIIIQQI36x", program, 0, len(frame), 0, address(self._frame), 0, 1))
        self._words = memoryview(self._attributes).cast("I")
        self._call = (_number(), Command.PROG_TEST_RUN, address(self._attributes), len(self._attributes))

    def __call__(self, repeat: int) -> None:
        """Run it so often; each run gets the frame that the previous one left. Raises ``BpfError``."""
        self._words[_REPEAT_AT] = repeat
        if _libc.syscall(*self._call) < 0:
            raise BpfError(ctypes.get_errno(), "run the program")


def info_of(opened: int) -> bytes:
    """Return ``struct bpf_prog_info`` of an open program, or ``bpf_link_info`` of a link."""
    info = bytearray(_INFO_BYTES)
    bpf(Command.OBJ_GET_INFO_BY_FD, bytearray(struct.pack("=IIQ", opened, len(info), address(info))), "ask for details")
    return bytes(info)
