"""Process that decodes a recording, as its parent handles it: start, pipe, end.

I/O, a process and pipes. It inherits little of the environment and no descriptors but its own. It ends when this object
is closed, or when the process that started it ends for any reason.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import LOOK_S, STOP_S

_ROOT: Final = Path(__file__).resolve().parents[2]
_CODE: Final = """
import sys
sys.path[:] = [folder for folder in sys.path if folder]
from proxy.recordings.child import main
main(sys.argv[1:])
"""
_PASSED: Final = ("PATH", "LD_LIBRARY_PATH", "PYTHONHOME", "LANG", "LC_ALL", "LC_CTYPE")
_PIPE_BYTES: Final = 1 << 20


class RecordingError(LocalError):
    """The decoder of a recording ended early: it exceeded a limit, crashed or was killed.

    Attributes:
        limit: ``memory`` or ``cpu`` where it met that limit, else empty.
    """

    def __init__(self, path: Path, why: str, limit: str = "") -> None:
        super().__init__(f"{path}: {why}")
        self.limit = limit


class StoppedError(Exception):
    """The caller that waits for the process has stopped."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Limits of the process.

    Args:
        wait_s: how long it may send nothing while the caller waits.
        file_bytes: length of a file in its scratch folder.
    """

    memory_bytes: int
    cpu_s: float
    wait_s: float
    file_bytes: int


class BagProcess:
    """A running decoder.

    Args:
        scratch: folder that it may write to.

    Raises:
        RecordingError: it cannot be started.
    """

    def __init__(self, path: Path, cost: Cost, scratch: Path | None) -> None:
        self._path = path
        self._cost = cost
        self._output, output = os.pipe()
        commands, self._commands = os.pipe()
        lifeline, self._held = os.pipe()
        numbers = (output, lifeline, cost.memory_bytes, math.ceil(cost.cpu_s), cost.file_bytes)
        words = [str(path), "" if scratch is None else str(scratch), *map(str, numbers)]
        environment = {name: os.environ[name] for name in _PASSED if name in os.environ}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(_ROOT))))
        environment["OPENBLAS_NUM_THREADS"] = "1"
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _CODE, *words],
                pass_fds=[output, lifeline],
                stdin=commands,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,  # Ctrl-C goes to the reading process, which then closes this one
            )
        except OSError as error:
            self._close_pipes()
            raise RecordingError(path, f"its decoder cannot be started: {error.strerror}") from error
        finally:
            for each in (output, commands, lifeline):
                os.close(each)
        os.set_blocking(self._output, False)
        with contextlib.suppress(OSError):  # the user's pipes have used up their quota
            fcntl.fcntl(self._output, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._poll = select.poll()
        self._poll.register(self._output, select.POLLIN)

    def request_messages(self) -> None:
        """Request all messages."""
        with contextlib.suppress(BrokenPipeError):  # it has ended; reading its output detects that
            os.write(self._commands, b"m")

    def read(self, size: int, waiting: Callable[[], bool] | None = None) -> bytes:
        """Return the next ``size`` bytes.

        Raises:
            RecordingError: it ended, or sent nothing for too long.
            StoppedError: ``waiting`` returned False.
        """
        pieces = []
        left = size
        while left:
            try:
                piece = os.read(self._output, min(left, _PIPE_BYTES))
            except BlockingIOError:
                self._wait(waiting)
                continue
            if not piece:
                raise self._ending()
            pieces.append(piece)
            left -= len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def close(self) -> None:
        """End the process."""
        self._close_pipes()  # the kernel then kills the process
        with contextlib.suppress(PermissionError):  # raised in a process that was confined after it started this one
            self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(STOP_S)

    def lacks(self, what: str) -> RecordingError:
        """Return the error for a decoder that met the limit of ``memory`` or ``cpu``."""
        if what == "memory":
            return RecordingError(self._path, f"to read it takes more than {self._cost.memory_bytes >> 20} MiB", what)
        return RecordingError(self._path, f"to read it takes more than {self._cost.cpu_s:.0f} s", what)

    def _close_pipes(self) -> None:
        for each in (self._held, self._commands, self._output):
            os.close(each)

    def _wait(self, waiting: Callable[[], bool] | None) -> None:
        until_s = time.monotonic() + self._cost.wait_s
        while not self._poll.poll(1e3 * (self._cost.wait_s if waiting is None else LOOK_S)):
            if waiting is not None and not waiting():
                raise StoppedError
            if time.monotonic() >= until_s:
                raise RecordingError(self._path, f"its decoder gave nothing for {self._cost.wait_s:.0f} s", "cpu")

    def _ending(self) -> RecordingError:
        """Return why the process has ended."""
        try:
            code = self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            return RecordingError(self._path, "its decoder closed its pipe")
        if code == -signal.SIGXCPU:
            return self.lacks("cpu")
        if code == -signal.SIGKILL:
            return RecordingError(self._path, "its decoder was killed, perhaps for want of memory")
        if code < 0:
            return RecordingError(self._path, f"its decoder crashed ({signal.Signals(-code).name})")
        return RecordingError(self._path, f"its decoder ended with status {code}")
