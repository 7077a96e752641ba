"""Wall clock of a single process, stepped from outside.

I/O. All processes share the machine's clock, and a time namespace shifts only the monotonic one. So a process that may
be stepped starts through this module, which replaces ``time.time`` and ``time.time_ns`` before it loads anything else.
The offset is eight bytes of a file that the bench writes. The product does not know of it. Calls to the kernel that
bypass the module ``time`` are not stepped.

    python -m faults.clock OFFSET_FILE gdp.cli.switch --config switch.yaml
"""

from __future__ import annotations

import mmap
import runpy
import struct
import sys
import time
from pathlib import Path
from typing import Final

_OFFSET: Final = struct.Struct("=q")  # offset in nanoseconds


class Clock:
    """Offset of the clock of one process, as the bench sets it; it outlives the process. ``path``: a file to create."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.write_bytes(_OFFSET.pack(0))

    def step(self, seconds: float) -> None:
        """Set the clock ahead of the machine's by so many seconds (behind, if negative) from now on."""
        with self.path.open("r+b") as file:
            file.write(_OFFSET.pack(round(seconds * 1e9)))


def follow(path: Path) -> None:
    """Shift this process's wall clock by the offset in the file; each query reads it."""
    with path.open("r+b") as file:
        offset = mmap.mmap(file.fileno(), _OFFSET.size)
    machine_ns = time.time_ns

    def stepped_ns() -> int:
        return machine_ns() + int(_OFFSET.unpack_from(offset)[0])

    time.time_ns = stepped_ns
    time.time = lambda: stepped_ns() / 1e9


if __name__ == "__main__":
    follow(Path(sys.argv[1]))
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
