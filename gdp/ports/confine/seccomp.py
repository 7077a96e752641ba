"""seccomp filter that refuses, with EPERM, system calls that a running node or a mere reader of files does not need.

I/O. Source: seccomp(2); include/uapi/linux/seccomp.h, filter.h, audit.h. It is a deny list, because ROS middleware and
Python libraries differ in the calls that they make. Calls of another architecture (32 bit, x32) are always refused.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import struct
from collections.abc import Iterable
from typing import Final

from gdp.ports.confine.system import call

__all__ = ["READER", "denied", "refuse"]

_FILTER, _TSYNC = 1, 1  # SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06  # BPF_LD|W|ABS, JMP|JEQ|K, JMP|JGE|K, RET|K
_ALLOW: Final = 0x7FFF0000
_REFUSE: Final = 0x00050000 | errno.EPERM
_X32: Final = 0x40000000
_NUMBER_AT, _ARCHITECTURE_AT = 0, 4
_STEP: Final = struct.Struct("=HBBI")
_MACHINES: Final = {"x86_64": (0xC000003E, 317), "aarch64": (0xC00000B7, 277)}  # AUDIT_ARCH, number of seccomp(2)
_NUMBERS: Final = {  # numbers on x86_64 and aarch64
    "acct": (163, 89),
    "add_key": (248, 217),
    "bpf": (321, 280),
    "chroot": (161, 51),
    "clock_settime": (227, 112),
    "delete_module": (176, 106),
    "finit_module": (313, 273),
    "fsconfig": (431, 431),
    "fsmount": (432, 432),
    "fsopen": (430, 430),
    "fspick": (433, 433),
    "init_module": (175, 105),
    "io_uring_enter": (426, 426),
    "io_uring_register": (427, 427),
    "io_uring_setup": (425, 425),
    "ioperm": (173, None),
    "iopl": (172, None),
    "kcmp": (312, 272),
    "kexec_file_load": (320, 294),
    "kexec_load": (246, 104),
    "keyctl": (250, 219),
    "mount": (165, 40),
    "mount_setattr": (442, 442),
    "move_mount": (429, 429),
    "open_by_handle_at": (304, 265),
    "open_tree": (428, 428),
    "perf_event_open": (298, 241),
    "pidfd_getfd": (438, 438),
    "pivot_root": (155, 41),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "ptrace": (101, 117),
    "quotactl": (179, 60),
    "reboot": (169, 142),
    "request_key": (249, 218),
    "setdomainname": (171, 162),
    "sethostname": (170, 161),
    "setns": (308, 268),
    "settimeofday": (164, 170),
    "swapoff": (168, 225),
    "swapon": (167, 224),
    "syslog": (103, 116),
    "umount2": (166, 39),
    "unshare": (272, 97),
    "userfaultfd": (323, 282),
}
_READER: Final = {  # network, processes, signals, memory beyond its limit, file marks: Landlock leaves them open
    "chmod": (90, None),
    "chown": (92, None),
    "clone": (56, 220),
    "clone3": (435, 435),
    "connect": (42, 203),
    "execve": (59, 221),
    "execveat": (322, 281),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "fchown": (93, 55),
    "fchownat": (260, 54),
    "fork": (57, None),
    "fremovexattr": (199, 16),
    "fsetxattr": (190, 7),
    "futimesat": (261, None),
    "kill": (62, 129),
    "lchown": (94, None),
    "lremovexattr": (198, 15),
    "lsetxattr": (189, 6),
    "memfd_create": (319, 279),
    "memfd_secret": (447, 447),
    "mq_open": (240, 180),
    "msgget": (68, 186),
    "pidfd_open": (434, 434),
    "pidfd_send_signal": (424, 424),
    "prctl": (157, 167),
    "prlimit64": (302, 261),
    "removexattr": (197, 14),
    "rt_sigqueueinfo": (129, 138),
    "rt_tgsigqueueinfo": (297, 240),
    "setpriority": (141, 140),
    "setrlimit": (160, 164),
    "setxattr": (188, 5),
    "shmget": (29, 194),
    "socket": (41, 198),
    "socketpair": (53, 199),
    "tgkill": (234, 131),
    "tkill": (200, 130),
    "utime": (132, None),
    "utimensat": (280, 88),
    "utimes": (235, None),
    "vfork": (58, None),
}
READER: Final = frozenset(_READER)  # refused to a process that only reads files and writes to a pipe


def denied(machine: str, spared: Iterable[str] = (), *, is_reader: bool = False) -> dict[str, int]:
    """Return the refused calls by name, with their numbers on a machine; empty if the machine is unknown.

    Args:
        machine: as ``uname -m`` prints it.
        spared: names of calls that are needed and therefore allowed.
        is_reader: whether to add the calls of ``READER``.
    """
    if machine not in _MACHINES:
        return {}
    column = list(_MACHINES).index(machine)
    left = set(spared)
    listed = {**_NUMBERS, **(_READER if is_reader else {})}
    numbers = {name: each[column] for name, each in listed.items() if name not in left}
    return {name: number for name, number in numbers.items() if number is not None}


def refuse(spared: Iterable[str] = (), *, is_reader: bool = False) -> bool:
    """Refuse the calls of ``denied`` to all threads of this process; return False if the machine is unknown.

    The thread must have ``no_new_privs``, or CAP_SYS_ADMIN.

    Raises:
        OSError: the system refuses.
    """
    machine = platform.machine()
    numbers = sorted(denied(machine, spared, is_reader=is_reader).values())
    if not numbers:
        return False
    architecture, seccomp = _MACHINES[machine]
    steps = [(_LOAD, 0, 0, _ARCHITECTURE_AT), (_EQUAL, 1, 0, architecture), (_RETURN, 0, 0, _REFUSE)]
    steps += [(_LOAD, 0, 0, _NUMBER_AT), (_AT_LEAST, len(numbers) + 1, 0, _X32)]
    steps += [(_EQUAL, len(numbers) - index, 0, number) for index, number in enumerate(numbers)]
    steps += [(_RETURN, 0, 0, _ALLOW), (_RETURN, 0, 0, _REFUSE)]
    program = ctypes.create_string_buffer(b"".join(_STEP.pack(*step) for step in steps))
    header = struct.pack("@HP", len(steps), ctypes.addressof(program))
    call(seccomp, _FILTER, _TSYNC, ctypes.create_string_buffer(header, len(header)))
    return True
