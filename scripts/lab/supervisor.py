"""Supervision of processes that report events: what they print is read together, and a death ends every wait.

I/O. A process is starting until it says ``ready``, and required from then on, until it is released.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from typing import Final

from gdp.ports.readiness import readable
from lab.process import Event, LabProcess

READY_S: Final = 60.0
TAIL: Final = 12

Note = Callable[[LabProcess, Event], object]


def exit_code(process: LabProcess, patience_s: float) -> int:
    """Return the exit code once a process has ended. Raises ``FailedError``: not in time."""
    process.reap(patience_s)
    return process.code or 0


class Supervisor:
    """Processes of a run. Methods that wait raise ``FailedError`` when a required process has ended.

    ``meanwhile``: is called in each wait; it returns the seconds until it wants to be called again.
    """

    def __init__(self) -> None:
        self.meanwhile: Callable[[], float] = lambda: math.inf
        self._said: dict[LabProcess, dict[str, Event]] = {}  # the newest event of each name
        self._notes: dict[LabProcess, Note] = {}
        self._starting: dict[LabProcess, tuple[float, Callable[[Event], object]]] = {}
        self._required: dict[LabProcess, int] = {}  # with a descriptor that is readable at its end

    def require(self, *processes: LabProcess) -> None:
        """Expect these processes not to end."""
        self._required |= {each: os.pidfd_open(each.pid) for each in processes}

    def release(self, process: LabProcess) -> None:
        """Let a required process end."""
        os.close(self._required.pop(process))

    def expect(self, process: LabProcess, then: Callable[[Event], object]) -> None:
        """Require a process as soon as it says ``ready``, and call ``then`` with that event."""
        self._said[process] = {}
        self._starting[process] = time.monotonic() + READY_S, then

    def ready(self, *processes: LabProcess) -> None:
        """Return when each has said ``ready``; from then on they are required."""
        for each in processes:
            self.expect(each, lambda _: None)
        self.follow(lambda: self._starting.keys().isdisjoint(processes))

    def hear(self, process: LabProcess, note: Note) -> None:
        """Give the events of a process to ``note`` as they come, and at once the newest of each name so far."""
        self._notes[process] = note
        for event in list(self._said.setdefault(process, {}).values()):
            note(process, event)

    def wait_for(self, process: LabProcess, name: str, patience_s: float) -> Event:
        """Return the newest event of this name of a process, when it has said one."""
        said = self._said.setdefault(process, {})
        if not self.follow(lambda: name in said or process.is_silent, patience_s):
            raise process.failed(f"did not say {name!r} within {patience_s:g} s", TAIL)
        if name not in said:
            raise process.failed(f"ended with code {exit_code(process, patience_s)} before it said {name!r}", TAIL)
        return said[name]

    def said(self, process: LabProcess, name: str) -> Event | None:
        """Return the newest event of this name of a process, if it has said one."""
        return self._said[process].get(name)

    def follow(self, is_over: Callable[[], bool], patience_s: float = math.inf) -> bool:
        """Take the events of all processes until ``is_over``; return whether that came true in time."""
        end_s = time.monotonic() + patience_s
        while not is_over():
            wait_s = min(end_s - time.monotonic(), self._check(), self.meanwhile())
            if time.monotonic() >= end_s or is_over():
                return is_over()
            speaking = [each for each in self._said if not each.is_silent]
            descriptors = [*(each.fileno() for each in speaking), *self._required.values()]
            readable(descriptors, max(wait_s, 0.0) if wait_s < math.inf else None)
            for process in speaking:
                for event in process.take_events():
                    self._take(process, event)
        return True

    def _check(self) -> float:
        """Return the seconds until a starting process is late; raises as the class says."""
        for process in self._required:
            if process.code is not None:
                raise process.failed(f"ended with code {process.code}", TAIL)
        for process, (end_s, _) in self._starting.items():
            if process.is_silent:
                raise process.failed(f"ended with code {exit_code(process, READY_S)} before it said 'ready'", TAIL)
            if time.monotonic() >= end_s:
                raise process.failed(f"did not say 'ready' within {READY_S:g} s", TAIL)
        return min((end_s for end_s, _ in self._starting.values()), default=math.inf) - time.monotonic()

    def _take(self, process: LabProcess, event: Event) -> None:
        self._said[process][event["event"]] = event
        if process in self._starting and event["event"] == "ready":
            _, then = self._starting.pop(process)
            self.require(process)
            then(event)
        if process in self._notes:
            self._notes[process](process, event)
