"""Telling Python and libc how a node uses memory: the same few megabytes again and again, and no reference cycles.

Place: shell; called once, when a node has started.
Source: mallopt(3). Left alone, glibc gives the top of the heap back after each large message and faults it in again for
the next: about a millisecond for every megabyte on a virtual machine.
"""

from __future__ import annotations

import ctypes
import gc
from typing import Final

__all__ = ["tune_memory"]

_M_TRIM_THRESHOLD: Final = -1
_M_TOP_PAD: Final = -2
_M_MMAP_THRESHOLD: Final = -3
_KEEP_BYTES: Final = 128 << 20  # a heap that has grown so far beyond its use is given back
_PAD_BYTES: Final = 4 << 20
_LARGE_BYTES: Final = 32 << 20  # the largest that glibc takes for this


def tune_memory() -> None:
    """Keep the heap as large as messages make it, and leave what was made at the start out of garbage collection.

    Frames and messages hold no cycles, so the collector would find nothing among them; looking through all modules
    again and again would only make some of them late.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # glibc; others know better by themselves
        mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
        mallopt(_M_TOP_PAD, _PAD_BYTES)
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 100)
