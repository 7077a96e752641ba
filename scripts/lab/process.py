"""Process of a run: started as the leader of its own group, awaited by lines that it prints, ended.

I/O. Its standard error goes to a log of the run, whose last line is the reason if it fails. Lines are JSON objects,
as ``peers.jsonl`` of the benches writes and reads them.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from gdp.closing import ClosedOnExit
from gdp.errors import GdpError
from gdp.host.processes import Process, end_all
from gdp.host.run_registry import Run, RunRegistry
from gdp.ports.readiness import readable

ROOT: Final = Path(__file__).resolve().parents[2]
_SCRIPTS: Final = ROOT / "scripts"
_REASON_CHARS: Final = 200
_CLOSE_S: Final = 5.0
_ANSWER_S: Final = 600.0
_FINISH_S: Final = 60.0
_PAUSE_S: Final = 0.05

Event = dict[str, Any]  # a line of JSON by which a process reports
T = TypeVar("T")
_ProcessT = TypeVar("_ProcessT", bound="LabProcess")


def python_path(*first: Path) -> str:
    """Return the present ``PYTHONPATH`` after these folders, and after it the project and its laboratory."""
    inherited = os.getenv("PYTHONPATH", "").split(os.pathsep)
    return os.pathsep.join(dict.fromkeys(filter(None, [*map(str, first), *inherited, str(ROOT), str(_SCRIPTS)])))


def python_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the present environment with this extension, in which Python imports the project and its laboratory."""
    return {**os.environ, "PYTHONPATH": python_path(), **environment}


def calling(function: Callable[..., object], *words: object) -> list[str]:
    """Return the command line of a process that calls a function of a module with these texts."""
    return [sys.executable, "-m", "lab.call", f"{function.__module__}:{function.__qualname__}", *map(str, words)]


@contextmanager
def new_run() -> Iterator[Run]:
    """Begin a run; leaving ends it, and removes what it has made."""
    run = RunRegistry().start()
    try:
        yield run
    finally:
        run.end()


class FailedError(GdpError):
    """A process ended too early, was silent for too long, or reported a failure."""


class UndoneOnExit(ClosedOnExit):
    """Context manager that undoes what its constructor has begun and put on ``_undo``."""

    _undo: ExitStack

    def close(self) -> None:
        """Undo it, the last first."""
        self._undo.close()


class LabProcess(ClosedOnExit):
    """Running process; a context manager that ends it, and its group with it.

    Args:
        run: records it, so that the clean-up of the run ends it; None: the caller alone ends it.
        label: display name, such as ``switch nuc1``; it names the log.
        argv: the command line; inherited by exec, so that the process id stays.
        environment: extends the present one, in which the project can be imported.
        log: file to append to; None: one in the run's directory.
        folder: where it runs; None: where this process does.
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
        folder: Path | None = None,
        heard: bool = True,
        has_orders: bool = False,
    ) -> None:
        self.label = label
        home = Path() if run is None else run.directory
        self.log = log or home / f"{label.replace(' ', '-')}.log"
        self._unread = b""
        self.is_silent = not heard  # it prints nothing more
        with self.log.open("ab") as errors:
            self._log_from = errors.tell()
            self._process = subprocess.Popen(
                argv,
                stdin=subprocess.PIPE if has_orders else subprocess.DEVNULL,
                stdout=subprocess.PIPE if heard else errors,
                stderr=errors,
                cwd=folder,
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

    def answer(self: _ProcessT, text: str) -> _ProcessT:
        """Give it a line, and nothing after it; return it."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError), self._process.stdin as file:  # it may not ask
            file.write(text.encode() + b"\n")
        self._process.stdin = None
        return self

    def close_orders(self) -> None:
        """Give no more commands; a process that reads them gets a moment to end by itself."""
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it ended before
                self._process.stdin.close()
            self._process.stdin = None
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_CLOSE_S)

    def reap(self, timeout_s: float | None = None) -> str:
        """Return, when the process has ended, what it printed and nothing has read; harmless where it was called.

        Raises ``FailedError``: it goes on after this time.
        """
        try:
            if self._process.stdout is None or self._process.stdout.closed:
                self._process.wait(timeout_s)
                return ""
            printed, _ = self._process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired as error:
            raise self.failed(f"still runs after {timeout_s:g} s") from error
        return (self._unread + printed).decode(errors="replace")

    def output(self, patience_s: float = _FINISH_S) -> str:
        """Return the rest of what it prints, once it has ended well by itself. Raises ``FailedError``: it failed."""
        printed = self.reap(patience_s)
        if self.code:
            raise self.failed(f"ended with code {self.code} after {printed!r}")
        return printed

    def finish(self, number: signal.Signals = signal.SIGINT, patience_s: float = _FINISH_S) -> str:
        """Signal the process, as Ctrl-C does by default, and ``reap`` it."""
        self.send(number)
        return self.reap(patience_s)

    def read(self, patience_s: float) -> Event:
        """Return the next line that it prints, a JSON object.

        Raises ``FailedError``: it ended, or printed nothing in time, or a reason why it refuses, or something else.
        """
        said = self._event(self.read_line(patience_s))
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

    def ask(self, **values: object) -> Event:
        """Send a command and return the answer; raises as ``read``."""
        self.tell(**values)
        return self.read(_ANSWER_S)

    def has_line(self, patience_s: float) -> bool:
        """Return whether a line is ready, or arrives in time; raises as ``read`` where none can arrive."""
        if b"\n" not in self._unread and readable([self], patience_s):
            part = os.read(self.fileno(), 1 << 16)
            if not part:
                raise self.failed("ended")
            self._unread += part
        return b"\n" in self._unread

    def fileno(self) -> int:
        """Return the descriptor of what it prints."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def take_events(self) -> list[Event]:
        """Return what it has reported since the last call; waits for nothing. Raises ``FailedError``: as ``read``."""
        while not self.is_silent and readable([self], 0.0):
            part = os.read(self.fileno(), 1 << 16)
            self._unread += part
            self.is_silent = not part
        *lines, self._unread = self._unread.split(b"\n")
        return [self._event(line) for line in lines]

    def _event(self, line: bytes) -> Event:
        """Return what a line reports. Raises ``FailedError``: it is no JSON object."""
        try:
            said: object = json.loads(line)
        except ValueError:
            said = None
        if not isinstance(said, dict):
            raise FailedError(f"{self.label} said {line.decode(errors='replace')[:_REASON_CHARS]!r}")
        return said

    def read_line(self, patience_s: float) -> bytes:
        """Return the next line that it prints, of any content; raises as ``read``."""
        deadline_s = time.monotonic() + patience_s
        while not self.has_line(max(deadline_s - time.monotonic(), 0.0)):
            if time.monotonic() >= deadline_s:
                raise self.failed(f"said nothing for {patience_s:g} s")
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def read_until(self, *signs: str, patience_s: float = _FINISH_S) -> str:
        """Return the next line that it prints with one of these texts, others are skipped; raises as ``read``."""
        while True:
            line = self.read_line(patience_s).decode(errors="replace")
            if any(sign in line for sign in signs):
                return line

    @property
    def logged(self) -> str:
        """Return its part of the log."""
        return self.log.read_bytes()[self._log_from :].decode(errors="replace")

    def until_logged(self, pattern: str, times: int = 1, patience_s: float = _FINISH_S) -> str:
        """Return the line of its log in which a pattern is found for the last of so many times.

        Raises ``FailedError``: it has ended, or not in time.
        """

        def found() -> str:
            """Look at the exit code before the log, which is whole then."""
            has_ended = self.code is not None
            lines = [line for line in self.logged.splitlines() if re.search(pattern, line)]
            if len(lines) >= times:
                return lines[times - 1]
            if has_ended:
                raise self.failed(f"ended before it logged {pattern!r}")
            return ""

        return until(found, lambda: f"{self.label} logs {pattern!r}, but: {self.logged}", patience_s)

    def failed(self, how: str, lines: int = 1) -> FailedError:
        """Return the error for this process's failure, with the last line of its log, or so many below each other."""
        with self.log.open(encoding="utf-8", errors="replace") as file:
            last = deque((line.rstrip() for line in file if line.strip()), maxlen=lines)
        if lines > 1:
            return FailedError("\n    ".join([f"{self.label} {how}", *last]))
        return FailedError(f"{self.label} {how}: {''.join(last)[-_REASON_CHARS:] or 'without a word'}")


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
    found: Callable[[], T],
    what: object | Callable[[], object] = "it did not come about",
    patience_s: float = 60.0,
    meanwhile: Callable[[], object] | None = None,
) -> T:
    """Return what a function finds once that is true; nothing here is notified of it.

    ``what``: is missing, or a function that says so. ``meanwhile``: is called between two looks, and waits a moment;
    None: a pause. Raises ``FailedError``: not in time.
    """
    end_s = time.monotonic() + patience_s
    while not (value := found()):
        if time.monotonic() > end_s:
            raise FailedError(f"{what() if callable(what) else what}: not within {patience_s:g} s")
        if meanwhile is None:
            time.sleep(_PAUSE_S)
        else:
            meanwhile()
    return value
