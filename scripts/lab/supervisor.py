"""Supervision of processes that report events: what they print is read together, and a death ends every wait.

I/O. A process is starting until it says ``ready``, and required from then on, until it is released.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Collection
from typing import Final

from gdp.ports.readiness import readable
from lab.process import Event, FailedError, LabProcess

READY_S: Final = 60.0
_TAIL_LINES: Final = 12

Note = Callable[[LabProcess, Event], object]


def failed(process: LabProcess, how: str) -> FailedError:
    """Return the error for a process's failure, with the last lines of its log."""
    return FailedError("\n    ".join([f"{process.label} {how}", *process.last_lines(_TAIL_LINES)]))


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
        self._starting: dict[LabProcess, tuple[float, Callable[[Event], object]]] = {}
        self._required: dict[LabProcess, int] = {}  # with a descriptor that is readable at its end
        self._events: list[tuple[LabProcess, Event]] = []  # that came, and nothing has asked for

    def require(self, *processes: LabProcess) -> None:
        """Expect these processes not to end."""
        self._required |= {each: os.pidfd_open(each.pid) for each in processes}

    def release(self, process: LabProcess) -> None:
        """Let a required process end."""
        os.close(self._required.pop(process))

    def expect(self, process: LabProcess, then: Callable[[Event], object]) -> None:
        """Require a process as soon as it says ``ready``, and call ``then`` with that event."""
        self._starting[process] = time.monotonic() + READY_S, then

    def ready(self, *processes: LabProcess) -> None:
        """Return when each has said ``ready``; from then on they are required."""
        for each in processes:
            self.expect(each, lambda _: None)
        self.follow((), lambda: self._starting.keys().isdisjoint(processes))

    def is_over(self, process: LabProcess) -> bool:
        """Return whether a process prints nothing more, and no event of it is kept."""
        return process.is_silent and all(each is not process for each, _ in self._events)

    def wait_for(self, process: LabProcess, name: str, patience_s: float) -> Event:
        """Return the next event of this name of a process; others on the way are skipped."""
        found: list[Event] = []

        def note(_: LabProcess, event: Event) -> None:
            """Keep the event that is waited for."""
            found.extend([event] if event["event"] == name else [])

        if not self.follow([process], lambda: bool(found) or self.is_over(process), note, patience_s):
            raise failed(process, f"did not say {name!r} within {patience_s:g} s")
        if not found:
            raise failed(process, f"ended with code {exit_code(process, patience_s)} before it said {name!r}")
        return found[0]

    def follow(
        self,
        sources: Collection[LabProcess],
        is_over: Callable[[], bool],
        note: Note = lambda *_: None,
        patience_s: float = math.inf,
    ) -> bool:
        """Give the events of these processes to ``note`` until ``is_over``; return whether that came true in time."""
        end_s = time.monotonic() + patience_s
        while True:
            self._hand_out(sources, is_over, note)
            if is_over():
                return True
            wait_s = min(end_s - time.monotonic(), self._check(), self.meanwhile())
            if time.monotonic() >= end_s or is_over():
                return is_over()
            heard = [each for each in {*sources, *self._starting} if not each.is_silent]
            descriptors = [*(each.fileno() for each in heard), *self._required.values()]
            readable(descriptors, max(wait_s, 0.0) if wait_s < math.inf else None)
            self._events += [(each, event) for each in heard for event in each.take_events()]

    def _check(self) -> float:
        """Return the seconds until a starting process is late; raises as the class says."""
        for process in self._required:
            if process.code is not None:
                raise failed(process, f"ended with code {process.code}")
        for process, (end_s, _) in self._starting.items():
            if self.is_over(process):
                raise failed(process, f"ended with code {exit_code(process, READY_S)} before it said 'ready'")
            if time.monotonic() >= end_s:
                raise failed(process, f"did not say 'ready' within {READY_S:g} s")
        return min((end_s for end_s, _ in self._starting.values()), default=math.inf) - time.monotonic()

    def _hand_out(self, sources: Collection[LabProcess], is_over: Callable[[], bool], note: Note) -> None:
        """Hand out the events that came, until it is over; those of other processes are kept."""
        kept = []
        while self._events and not is_over():
            process, event = self._events.pop(0)
            if process in self._starting and event["event"] == "ready":
                _, then = self._starting.pop(process)
                self.require(process)
                then(event)
            elif process in sources:
                note(process, event)
            else:
                kept.append((process, event))
        self._events[:0] = kept
