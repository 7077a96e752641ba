"""Memory tuning of Python and libc for a node, which reuses the same few megabytes and makes no reference cycles.

I/O; called once, when a node has started.
Source: mallopt(3). By default glibc returns the top of the heap after each large message and faults it in again for the
next one. That costs about a millisecond per megabyte on a virtual machine.
"""

from __future__ import annotations

import ctypes
import gc
from typing import Final

_M_TRIM_THRESHOLD: Final = -1
_M_TOP_PAD: Final = -2
_M_MMAP_THRESHOLD: Final = -3
_KEEP_BYTES: Final = 128 << 20  # a heap that exceeds its use by this much is returned
_PAD_BYTES: Final = 4 << 20
_LARGE_BYTES: Final = 32 << 20  # the largest value that glibc accepts


def tune_memory() -> None:
    """Keep the heap at the size that messages need, and exclude the objects of the start from garbage collection.

    The start leaves a few dozen objects of garbage, which are not worth a search. Frames and messages form no cycles,
    so the collector would find nothing among them. Repeated scans of all modules would only delay some of them.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # glibc only; other libraries need no tuning
        mallopt(_M_TRIM_THRESHOLD, _KEEP_BYTES)
        mallopt(_M_TOP_PAD, _PAD_BYTES)
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)
    gc.freeze()
    gc.set_threshold(20_000, 20, 100)
