"""Starting what outlives its starter, without a moment in which nobody knows of it.

I/O. The process waits for one line on its standard input, which it is sent only when the run's record names it
and the record is kept; if its starter dies before, it reads the end of its input instead, and ends.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.run_registry import Run

__all__ = ["spawn_detached"]

_HELD: Final = {signal.SIGUSR1, signal.SIGUSR2}  # until the process can take them; else they would end it


def spawn_detached(
    run: Run,
    space: Path,
    module: Sequence[str],
    log: Path,
    confine: Callable[[int], None] = lambda _: None,
    *,
    is_heard: bool = False,
) -> int:
    """Start a Python module with arguments in a namespace, as the leader of a session; return its process id.

    Args:
        log: a file that takes all that it says.
        confine: called with the process id before it does anything.
        is_heard: wait for the first word on its standard output, which is to be the last one there.

    Raises:
        OSError: it cannot be started.
        LocalError: it ended at once; or what ``confine`` raises, and it has ended then.
    """
    (hears, says), (answer, answers) = os.pipe2(os.O_CLOEXEC), os.pipe2(os.O_CLOEXEC)
    try:
        try:
            process = _start(space, module, log, hears, answers if is_heard else None)
        finally:
            os.close(hears)
            os.close(answers)
        try:
            confine(process.pid)
            run.note_process(process.pid)
            run.keep()
            os.write(says, b"go\n")
            if is_heard and not os.read(answer, 1):
                raise BrokenPipeError
        except BrokenPipeError as error:
            raise LocalError(f"{module[0]} ended with code {process.wait()}; see {log}") from error
        except BaseException:
            process.kill()
            process.wait()
            raise
    finally:
        os.close(says)
        os.close(answer)
    threading.Thread(target=process.wait, name=f"reaps {process.pid}", daemon=True).start()
    return process.pid


def _start(space: Path, module: Sequence[str], log: Path, hears: int, answers: int | None) -> subprocess.Popen[bytes]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD)
    try:
        with log.open("ab") as said:
            return subprocess.Popen(
                ["nsenter", f"--net={space}", "--", sys.executable, "-m", *module],
                stdin=hears,
                stdout=said if answers is None else answers,
                stderr=said,
                start_new_session=True,
            )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
