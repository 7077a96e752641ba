"""Background load of a bench: one process for each core, which computes for half of the time.

I/O. What else runs on a robot keeps the cores warm and in use. A process is pinned to its core. In each period of 10 ms
it computes for 5 ms of the clock, then it sleeps. A context manager ends exactly these processes; they also end when
the pipe from their parent closes.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Final

SHARE: Final = 0.5  # of each core
LOADS: Final = {"none": (False,), "half": (True,), "both": (False, True)}  # of ``--load``: with or without, in turn
_PERIOD_S: Final = 0.01


class BackgroundLoad:
    """Load on every core that this process may use, from ``__enter__`` to ``__exit__``."""

    def __init__(self) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> BackgroundLoad:
        for core in sorted(os.sched_getaffinity(0)):
            command = [sys.executable, __file__, str(core)]
            self._processes.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        for process in self._processes:
            assert process.stdout is not None
            process.stdout.readline()  # it runs on its core
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for process in self._processes:
            process.kill()
        for process in self._processes:
            with process:  # waits, and closes the pipes
                pass
        self._processes.clear()


def load_of(loaded: bool) -> AbstractContextManager[object]:
    """Return a context with the load, or without."""
    return BackgroundLoad() if loaded else nullcontext()


def compute(core: int) -> None:
    """Compute on a core for half of the time, until standard input closes."""
    os.sched_setaffinity(0, {core})
    print("ready", flush=True)
    begun_s = time.monotonic()
    while not select.select([sys.stdin], [], [], max(begun_s - time.monotonic(), 0.0))[0]:
        while time.monotonic() < begun_s + SHARE * _PERIOD_S:
            pass
        begun_s = max(begun_s, time.monotonic() - _PERIOD_S) + _PERIOD_S


if __name__ == "__main__":
    compute(int(sys.argv[1]))
