"""System calls without a wrapper in the standard library, called through ctypes.

I/O. A call that fails raises ``OSError`` with its errno.
"""

from __future__ import annotations

import ctypes
import os
from typing import Final

LIBC: Final = ctypes.CDLL(None, use_errno=True)
LIBC.syscall.restype = ctypes.c_long


def call(number: int, *arguments: object) -> int:
    """Return the result of a system call; integers are passed as 64 bits."""
    given = [ctypes.c_long(each) if isinstance(each, int) else each for each in arguments]
    return checked(LIBC.syscall(ctypes.c_long(number), *given))


def prctl(option: int, second: int = 0, third: int = 0) -> int:
    """Return the result of prctl(2)."""
    zero = ctypes.c_ulong(0)
    return checked(LIBC.prctl(option, ctypes.c_ulong(second), ctypes.c_ulong(third), zero, zero))


def checked(result: int) -> int:
    """Return a result that is not negative."""
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result
