"""Capabilities of the calling thread and of the programs that it starts.

I/O. Source: capabilities(7), capget(2); include/uapi/linux/capability.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Collection
from enum import IntEnum
from typing import Final

from gdp.ports.confine.system import LIBC, checked, prctl

_VERSION_3: Final = 0x20080522
_BOUNDING_DROP: Final = 24  # PR_CAPBSET_DROP
_HIGHEST: Final = 63


class Capability(IntEnum):
    """Capabilities that a node may need; the values are the kernel's."""

    DAC_OVERRIDE = 1
    DAC_READ_SEARCH = 2
    NET_ADMIN = 12
    NET_RAW = 13
    SYS_ADMIN = 21
    PERFMON = 38
    BPF = 39


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _Words(ctypes.Structure):
    _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32), ("inheritable", ctypes.c_uint32))


def drop_bounding() -> None:
    """Empty the bounding set: no program started from now on gets a capability, not even one of root.

    Raises:
        OSError: EPERM without CAP_SETPCAP.
    """
    for number in range(_HIGHEST + 1):
        try:
            prctl(_BOUNDING_DROP, number)
        except OSError:
            if number <= Capability.BPF:
                raise
            return  # beyond the last capability that this kernel knows


def keep_only(wanted: Collection[Capability]) -> None:
    """Drop all capabilities of this thread except the wanted ones; the call adds none.

    Raises:
        OSError: the system refuses.
    """
    header, data = _Header(_VERSION_3, 0), (_Words * 2)()
    checked(LIBC.capget(ctypes.byref(header), data))
    for index, words in enumerate(data):
        mask = sum(1 << (each % 32) for each in wanted if each // 32 == index)
        words.permitted &= mask
        words.effective = words.permitted
        words.inheritable = 0
    checked(LIBC.capset(ctypes.byref(header), data))
