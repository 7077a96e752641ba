"""Process of a bench: started on a machine, controlled by lines of JSON, ended.

I/O. Its standard error goes to a file of the run, whose last line is the reason if it fails. ``peers.jsonl`` is the
other side.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, TypeVar

from gdp.host.processes import Process, end_all
from gdp.host.run_registry import Run

_BENCH: Final = Path(__file__).resolve().parents[1]
_REASON_CHARS: Final = 200
_CLOSE_S: Final = 5.0
_ANSWER_S: Final = 600.0
_PAUSE_S: Final = 0.05

T = TypeVar("T")


class FailedError(Exception):
    """A process of a baseline ended, was silent for too long, or reported a failure."""


class Started:
    """Running process; a context manager that ends it, and its group with it.

    Args:
        command: from the command line to the one that enters the machine.
        has_orders: it reads commands, and ends by itself when there are no more.
    """

    def __init__(
        self,
        run: Run,
        what: str,
        command: Callable[[Sequence[str]], list[str]],
        arguments: Sequence[str],
        *,
        has_orders: bool = False,
    ) -> None:
        self._what = what
        self._unread = b""
        self._log = run.directory / f"{what.replace(' ', '-')}.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                command([sys.executable, *arguments]),
                stdin=subprocess.PIPE if has_orders else subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(_BENCH), os.getenv("PYTHONPATH"))))},
                start_new_session=True,
            )
        run.note_process(self._process.pid)

    @property
    def pid(self) -> int:
        """Return the process's id, the same in every namespace of the row."""
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Return its exit code; None while it runs."""
        return self._process.poll()

    def __enter__(self) -> Started:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it ended before
                self._process.stdin.close()
            self._process.stdin = None
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_CLOSE_S)
        if self._process.poll() is None:
            with suppress(ProcessLookupError):  # it ended by itself just now
                end_all([Process.from_pid(self.pid)])
        self._process.communicate()

    def read(self, patience_s: float) -> dict[str, object]:
        """Return the next line that it prints, a JSON object.

        Raises:
            FailedError: it ended, or printed nothing in time, or a reason why it refuses, or something else.
        """
        said = json.loads(self.read_line(patience_s))
        if not isinstance(said, dict):
            raise FailedError(f"{self._what} said {said!r}")
        if "refused_because" in said:
            raise FailedError(str(said["refused_because"]))
        return said

    def tell(self, **values: object) -> None:
        """Send a command, without waiting for an answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(values).encode() + b"\n")
        self._process.stdin.flush()

    def ask(self, **values: object) -> dict[str, object]:
        """Send a command and return the answer; raises as ``read``."""
        self.tell(**values)
        return self.read(_ANSWER_S)

    def has_line(self, patience_s: float) -> bool:
        """Return whether a line is ready, or arrives in time; raises as ``read`` where none can arrive."""
        assert self._process.stdout is not None
        if b"\n" not in self._unread and select.select([self._process.stdout], [], [], patience_s)[0]:
            part = os.read(self._process.stdout.fileno(), 1 << 16)
            if not part:
                raise FailedError(f"{self._what} ended: {self._reason()}")
            self._unread += part
        return b"\n" in self._unread

    def read_line(self, patience_s: float) -> bytes:
        """Return the next line that it prints, of any content; raises as ``read``."""
        assert self._process.stdout is not None
        deadline_s = time.monotonic() + patience_s
        while b"\n" not in self._unread:
            ready, _, _ = select.select([self._process.stdout], [], [], max(deadline_s - time.monotonic(), 0.0))
            if not ready:
                raise FailedError(f"{self._what} said nothing for {patience_s:g} s; {self._reason()}")
            part = os.read(self._process.stdout.fileno(), 1 << 16)
            if not part:
                raise FailedError(f"{self._what} ended: {self._reason()}")
            self._unread += part
        line, _, self._unread = self._unread.partition(b"\n")
        return line

    def _reason(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return said[-1][-_REASON_CHARS:] if said else "without a word"


def until(
    found: Callable[[], T], what: Callable[[], str], patience_s: float, meanwhile: Callable[[], object] | None = None
) -> T:
    """Return what a function finds once that is true; nothing here is notified of it.

    Args:
        what: says what is missing.
        meanwhile: is called between two looks, and waits a moment; None: a pause.

    Raises:
        FailedError: not in time.
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
    """Return a list of figures of a report.

    Raises:
        FailedError: it has none.
    """
    values = said.get(key)
    if not isinstance(values, list):
        raise FailedError(f"a list {key!r} was expected, not {said}")
    return [float(value) for value in values]
