"""seccomp filters: nodes are refused calls that they do not need, mere readers of files all that they do not make.

I/O. Source: seccomp(2); include/uapi/linux/seccomp.h, filter.h, audit.h. For nodes it is a deny list, because ROS
middleware and Python libraries differ in the calls that they make. A refused call fails with EPERM. Calls of another
architecture (32 bit, x32) are always refused.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import struct
from collections.abc import Collection, Iterable, Mapping
from typing import Final

from gdp.ports.confine.system import call

_FILTER, _TSYNC = 1, 1  # SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06  # BPF_LD|W|ABS, JMP|JEQ|K, JMP|JGE|K, RET|K
_ALLOW: Final = 0x7FFF0000
_REFUSE: Final = 0x00050000 | errno.EPERM
_UNKNOWN: Final = 0x00050000 | errno.ENOSYS
_X32: Final = 0x40000000
_NUMBER_AT, _ARCHITECTURE_AT, _FIRST_AT, _SECOND_AT = 0, 4, 16, 24  # of struct seccomp_data; low halves of arguments
_Step = tuple[int, int, int, int]
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
_READER: Final = {  # all that Python, SQLite and the decompressors call to read files and to write to a pipe
    "access": (21, None), "brk": (12, 214), "clock_getres": (229, 114), "clock_gettime": (228, 113),
    "clock_nanosleep": (230, 115), "close": (3, 57), "dup": (32, 23), "dup2": (33, None), "dup3": (292, 24),
    "exit": (60, 93), "exit_group": (231, 94), "faccessat": (269, 48), "faccessat2": (439, 439),
    "fadvise64": (221, 223), "fallocate": (285, 47), "fdatasync": (75, 83), "fstat": (5, 80), "fstatfs": (138, 44),
    "fsync": (74, 82), "ftruncate": (77, 46), "futex": (202, 98), "getcwd": (79, 17), "getdents64": (217, 61),
    "getegid": (108, 177), "geteuid": (107, 175), "getgid": (104, 176), "getpid": (39, 172), "getrandom": (318, 278),
    "getrusage": (98, 165), "gettid": (186, 178), "gettimeofday": (96, 169), "getuid": (102, 174), "lseek": (8, 62),
    "lstat": (6, None), "madvise": (28, 233), "mkdir": (83, None), "mkdirat": (258, 34), "mmap": (9, 222),
    "mprotect": (10, 226), "mremap": (25, 216), "munmap": (11, 215), "nanosleep": (35, 101), "newfstatat": (262, 79),
    "open": (2, None), "openat": (257, 56), "poll": (7, None), "ppoll": (271, 73), "pread64": (17, 67),
    "preadv": (295, 69), "pselect6": (270, 72), "pwrite64": (18, 68), "read": (0, 63), "readlink": (89, None),
    "readlinkat": (267, 78), "readv": (19, 65), "restart_syscall": (219, 128), "rmdir": (84, None),
    "rseq": (334, 293), "rt_sigaction": (13, 134), "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139),
    "sched_getaffinity": (204, 123), "sched_yield": (24, 124), "select": (23, None), "sendfile": (40, 71),
    "set_robust_list": (273, 99), "sigaltstack": (131, 132), "stat": (4, None), "statfs": (137, 43),
    "statx": (332, 291), "sysinfo": (99, 179), "truncate": (76, 45), "umask": (95, 166), "uname": (63, 160),
    "unlink": (87, None), "unlinkat": (263, 35), "write": (1, 64), "writev": (20, 66),
}  # fmt: skip
_OF_COMMANDS: Final = {  # calls that are allowed with these second arguments only
    "fcntl": ((72, 25), (0, 1, 2, 3, 5, 6, 7, 1030)),  # F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_*LK*, F_DUPFD_CLOEXEC
    "ioctl": ((16, 29), (0x5401, 0x541B, 0x5450, 0x5451)),  # TCGETS, FIONREAD, FIONCLEX, FIOCLEX
}

_OF_OPEN: Final = (1, 2, 3, 10, 26, 28)  # bpf(2): MAP_*_ELEM, PROG_TEST_RUN, MAP_UPDATE_BATCH, LINK_CREATE


def denied(machine: str, spared: Iterable[str] = ()) -> dict[str, int]:
    """Return the refused calls by name, with their numbers on a machine; empty if the machine is unknown.

    Args:
        machine: as ``uname -m`` prints it.
        spared: names of calls that are needed and therefore allowed.
    """
    left = set(spared)
    return {name: number for name, number in _numbers(machine, _NUMBERS).items() if name not in left}


def allowed(machine: str) -> dict[str, int]:
    """Return the calls that a reader of files may make, as ``denied``; ``fcntl`` and ``ioctl`` with some commands."""
    return _numbers(machine, {**_READER, **{name: numbers for name, (numbers, _) in _OF_COMMANDS.items()}})


def refuse(spared: Iterable[str] = (), *, uses_open_programs: bool = False) -> bool:
    """Refuse the calls of ``denied`` to all threads of this process; return False if the machine is unknown.

    The thread must have ``no_new_privs``, or CAP_SYS_ADMIN.

    Args:
        uses_open_programs: bpf(2) is allowed with the programs and maps that are open; it loads and makes none.

    Raises:
        OSError: the system refuses.
    """
    refused = denied(platform.machine(), spared)
    number = refused.pop("bpf", None) if uses_open_programs else None
    steps = [] if number is None else _on_command(number, _OF_OPEN, _FIRST_AT)
    return _install([*steps, *(step for each in refused.values() for step in _on(each, _REFUSE))], _ALLOW)


def allow_only_reading() -> bool:
    """Refuse all calls but those of ``allowed``, as ``refuse``; a call newer than all of them has ENOSYS."""
    numbers = allowed(platform.machine())
    steps = list[_Step]()
    for name, number in numbers.items():
        commands = _OF_COMMANDS[name][1] if name in _OF_COMMANDS else ()
        steps += _on_command(number, commands, _SECOND_AT) if commands else _on(number, _ALLOW)
    known = max([*numbers.values(), *denied(platform.machine()).values()], default=0)
    steps += [(_AT_LEAST, 0, 1, known + 1), (_RETURN, 0, 0, _UNKNOWN)]
    return _install(steps, _REFUSE)


def _numbers(machine: str, calls: Mapping[str, tuple[int | None, int | None]]) -> dict[str, int]:
    if machine not in _MACHINES:
        return {}
    column = list(_MACHINES).index(machine)
    return {name: number for name, each in calls.items() if (number := each[column]) is not None}


def _on(number: int, action: int) -> list[_Step]:
    """Return what ends the filter with an action if the loaded word is a number."""
    return [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, action)]


def _on_command(number: int, commands: Collection[int], at: int) -> list[_Step]:
    """Return what allows a call with some values of an argument, of which 32 bits count, and refuses others."""
    rest = [step for each in commands for step in _on(each, _ALLOW)]
    return [(_EQUAL, 0, len(rest) + 2, number), (_LOAD, 0, 0, at), *rest, (_RETURN, 0, 0, _REFUSE)]


def _install(rules: Iterable[_Step], otherwise: int) -> bool:
    machine = platform.machine()
    if machine not in _MACHINES:
        return False
    architecture, seccomp = _MACHINES[machine]
    steps = [(_LOAD, 0, 0, _ARCHITECTURE_AT), (_EQUAL, 1, 0, architecture), (_RETURN, 0, 0, _REFUSE)]
    steps += [(_LOAD, 0, 0, _NUMBER_AT), (_AT_LEAST, 0, 1, _X32), (_RETURN, 0, 0, _REFUSE)]
    steps += [*rules, (_RETURN, 0, 0, otherwise)]
    program = ctypes.create_string_buffer(b"".join(_STEP.pack(*step) for step in steps))
    header = struct.pack("@HP", len(steps), ctypes.addressof(program))
    call(seccomp, _FILTER, _TSYNC, ctypes.create_string_buffer(header, len(header)))
    return True
