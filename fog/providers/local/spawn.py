"""Start of detached processes that are recorded before they act.

I/O. The process waits for one line on its standard input. The starter sends it after the run's record, with the
process in it, is stored. If the starter dies before, the process reads end of file and ends.
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
from gdp.host.netns_files import reach
from gdp.host.run_registry import Run

_HELD: Final = {signal.SIGUSR1, signal.SIGUSR2}  # until the process handles them; by default they would end it


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
        confine: called with the process id before the process acts.
        is_heard: wait for the first output on its standard output, which must be the only one.

    Raises:
        OSError: it cannot be started.
        LocalError: the process ended at once; or the error of ``confine``, after which the process has ended.
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
            run.retain()
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
                ["nsenter", f"--net={reach(space) or space}", "--", sys.executable, "-m", *module],
                stdin=hears,
                stdout=said if answers is None else answers,
                stderr=said,
                start_new_session=True,
            )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
