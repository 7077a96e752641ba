"""Background load of a bench: one process for each core, which computes for half of the time.

I/O. What else runs on a robot keeps the cores warm and in use. A process is pinned to its core. In each period of 10 ms
it computes for 5 ms of the clock, then it sleeps. A context manager ends exactly these processes; they also end when
the pipe from their parent closes.
"""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from lab.process import LabProcess

SHARE: Final = 0.5  # of each core
LOADS: Final = {"none": (False,), "half": (True,), "both": (False, True)}  # of ``--load``: with or without, in turn
_PERIOD_S: Final = 0.01


@contextmanager
def load_of(*, loaded: bool) -> Iterator[Sequence[LabProcess]]:
    """Run the load on every core that this process may use, or none; yield its processes."""
    with ExitStack() as stack:
        processes = []
        for core in sorted(os.sched_getaffinity(0)) if loaded else ():
            argv = [sys.executable, __file__, str(core)]
            load = LabProcess(None, f"load of core {core}", argv, log=Path(os.devnull), has_orders=True)
            processes.append(stack.enter_context(load))
        for each in processes:
            each.read_until("ready")
        yield processes


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
