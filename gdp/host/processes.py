"""Processes identified by id and start time, so that a reused process id is never signalled.

I/O. Source: proc(5), field 22 of ``/proc/PID/stat``; pidfd_open(2).
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gdp.ports.readiness import readable


@dataclass(frozen=True, slots=True)
class Process:
    """One process, leader of its own process group: id, and start in clock ticks since boot."""

    pid: int
    started: int

    @classmethod
    def from_pid(cls, pid: int) -> Process:
        """Return the running process ``pid``. Raises ``ProcessLookupError``: there is no such process."""
        started = _started(pid)
        if started is None:
            raise ProcessLookupError(pid)
        return cls(pid, started)

    @property
    def alive(self) -> bool:
        """Return whether this exact process still runs (a zombie does not)."""
        return _started(self.pid) == self.started


def boot_id() -> str:
    """Return a value that changes with every boot of this machine; process ids are valid within one boot only."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def _started(pid: int) -> int | None:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = stat.rpartition(")")[2].split()  # the name before it may hold blanks and parentheses
    return None if fields[0] in ("Z", "X") else int(fields[19])


def end_all(processes: Iterable[Process], patience_s: float = 3.0, *, are_leaders: bool = True) -> None:
    """End the groups of these processes: SIGTERM, and after ``patience_s`` SIGKILL.

    Processes that have ended are skipped.

    Args:
        are_leaders: whether they lead groups; otherwise each is ended alone.
    """
    signal_to = os.killpg if are_leaders else os.kill
    waiting: dict[int, Process] = {}
    try:
        for process in processes:
            with suppress(ProcessLookupError):
                descriptor = os.pidfd_open(process.pid)
                waiting[descriptor] = process
                if process.alive:
                    signal_to(process.pid, signal.SIGTERM)
        for process in _still_running(waiting, patience_s):
            with suppress(ProcessLookupError):
                if process.alive:
                    signal_to(process.pid, signal.SIGKILL)
        _still_running(waiting, patience_s)
    finally:
        for descriptor in waiting:
            os.close(descriptor)


def _still_running(waiting: dict[int, Process], patience_s: float) -> list[Process]:
    """Wait for the process descriptors to become readable, which happens when their process ends."""
    left = {descriptor: process for descriptor, process in waiting.items() if process.alive}
    deadline_s = time.monotonic() + patience_s
    while left and (rest_s := deadline_s - time.monotonic()) > 0:
        for descriptor in readable(left, rest_s):
            del left[descriptor]
    return list(left.values())
