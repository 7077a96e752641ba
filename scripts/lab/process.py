"""Process of a run: started as the leader of its own group, awaited by lines that it prints, ended.

I/O. Its standard error goes to a log of the run, whose last line is the reason if it fails. Lines are JSON objects,
as ``peers.jsonl`` of the benches writes and reads them.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar

from gdp.errors import GdpError
from gdp.host.processes import Process, end_all
from gdp.host.run_registry import Run
from gdp.ports.readiness import readable

_SCRIPTS: Final = Path(__file__).resolve().parents[1]
_REASON_CHARS: Final = 200
_CLOSE_S: Final = 5.0
_ANSWER_S: Final = 600.0
_PAUSE_S: Final = 0.05

T = TypeVar("T")
_ProcessT = TypeVar("_ProcessT", bound="LabProcess")


def python_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the present environment with this extension, in which Python imports the project and its laboratory."""
    paths = os.getenv("PYTHONPATH"), str(_SCRIPTS.parent), str(_SCRIPTS)
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **environment}


class FailedError(GdpError):
    """A process ended too early, was silent for too long, or reported a failure."""


class LabProcess:
    """Running process; a context manager that ends it, and its group with it.

    Args:
        run: records it, so that the clean-up of the run ends it; None: the caller alone ends it.
        label: display name, such as ``switch nuc1``; it names the log.
        argv: the command line; inherited by exec, so that the process id stays.
        environment: extends the present one, in which the project can be imported.
        log: file to append to; None: one in the run's directory.
        heard: its standard output is read, and does not go to the log.
        has_orders: it reads commands, and ends by itself when there are no more.
    """

    def __init__(
        self,
        run: Run | None,
        label: str,
        argv: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        log: Path | None = None,
        heard: bool = True,
        has_orders: bool = False,
    ) -> None:
        self.label = label
        folder = Path() if run is None else run.directory
        self.log = log or folder / f"{label.replace(' ', '-')}.log"
        self._unread = b""
        with self.log.open("ab") as errors:
            self._process = subprocess.Popen(
                argv,
                stdin=subprocess.PIPE if has_orders else subprocess.DEVNULL,
                stdout=subprocess.PIPE if heard else errors,
                stderr=errors,
                env=python_environment(environment or {}),
                start_new_session=True,
            )
        if run is not None:
            run.note_process(self.pid)

    @property
    def pid(self) -> int:
        """Return the process's id, the same in every namespace, which is also its group's."""
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Return its exit code; None while it runs."""
        return self._process.poll()

    def __enter__(self: _ProcessT) -> _ProcessT:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process and its group; harmless where it has ended."""
        end_processes([self])

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process, unless it has ended."""
        self._process.send_signal(number)

    def kill_group(self) -> None:
        """Kill the process and its group immediately; return when it has ended."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self.reap()

    def close_orders(self) -> None:
        """Give no more commands; a process that reads them gets a moment to end by itself."""
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it ended before
                self._process.stdin.close()
            self._process.stdin = None
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_CLOSE_S)

    def reap(self, timeout_s: float | None = None) -> None:
        """Return when the process has ended and its pipes are closed; harmless where they are."""
        if self._process.stdout is None or self._process.stdout.closed:
            self._process.wait(timeout_s)
        else:
            self._process.communicate(timeout=timeout_s)

    def read(self, patience_s: float) -> dict[str, object]:
        """Return the next line that it prints, a JSON object.

        Raises ``FailedError``: it ended, or printed nothing in time, or a reason why it refuses, or something else.
        """
        said = json.loads(self.read_line(patience_s))
        if not isinstance(said, dict):
            raise FailedError(f"{self.label} said {said!r}")
        if "refused_because" in said:
            raise FailedError(str(said["refused_because"]))
        return said

    def tell(self, **values: object) -> None:
        """Send a command, without waiting for an answer. Raises ``FailedError``: it has ended."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(values).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise self.failed("ended") from error

    def ask(self, **values: object) -> dict[str, object]:
        """Send a command and return the answer; raises as ``read``."""
        self.tell(**values)
        return self.read(_ANSWER_S)

    def has_line(self, patience_s: float) -> bool:
        """Return whether a line is ready, or arrives in time; raises as ``read`` where none can arrive."""
        assert self._process.stdout is not None
        descriptor = self._process.stdout.fileno()
        if b"\n" not in self._unread and readable([descriptor], patience_s):
            part = os.read(descriptor, 1 << 16)
            if not part:
                raise self.failed("ended")
            self._unread += part
        return b"\n" in self._unread

    def read_line(self, patience_s: float) -> bytes:
        """Return the next line that it prints, of any content; raises as ``read``."""
        deadline_s = time.monotonic() + patience_s
        while not self.has_line(max(deadline_s - time.monotonic(), 0.0)):
            if time.monotonic() >= deadline_s:
                raise self.failed(f"said nothing for {patience_s:g} s")
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def failed(self, how: str) -> FailedError:
        """Return the error for this process's failure, with the last line of its log."""
        return FailedError(f"{self.label} {how}: {''.join(self.last_lines(1))[-_REASON_CHARS:] or 'without a word'}")

    def last_lines(self, count: int) -> Collection[str]:
        """Return the last lines of its log that are not empty."""
        with self.log.open(encoding="utf-8", errors="replace") as file:
            return deque((line.rstrip() for line in file if line.strip()), maxlen=count)


def end_processes(processes: Collection[LabProcess], patience_s: float = 3.0) -> None:
    """End processes and their groups at once, by SIGKILL after this time; return when all have ended."""
    living = list[Process]()
    for each in processes:
        each.close_orders()
        if each.code is None:  # a former id may be another's now
            with suppress(ProcessLookupError):  # it has just ended by itself
                living.append(Process.from_pid(each.pid))
    end_all(living, patience_s)
    for each in processes:
        each.reap()


def until(
    found: Callable[[], T], what: Callable[[], str], patience_s: float, meanwhile: Callable[[], object] | None = None
) -> T:
    """Return what a function finds once that is true; nothing here is notified of it.

    ``what``: says what is missing. ``meanwhile``: is called between two looks, and waits a moment; None: a pause.
    Raises ``FailedError``: not in time.
    """
    end_s = time.monotonic() + patience_s
    while not (value := found()):
        if time.monotonic() > end_s:
            raise FailedError(f"{what()}: not within {patience_s:g} s")
        if meanwhile is None:
            time.sleep(_PAUSE_S)
        else:
            meanwhile()
    return value


def figures_of(said: Mapping[str, object]) -> dict[str, float]:
    """Return the figures of a report, by key."""
    return {key: value for key, value in said.items() if isinstance(value, int | float)}


def floats_of(said: Mapping[str, object], key: str) -> list[float]:
    """Return a list of figures of a report. Raises ``FailedError``: it has none."""
    values = said.get(key)
    if not isinstance(values, list):
        raise FailedError(f"a list {key!r} was expected, not {said}")
    return [float(value) for value in values]
