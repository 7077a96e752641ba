"""Background process of a site's single supervisor, identified by a lock that the kernel releases with the process."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

from fog.site import Site
from gdp.errors import LocalError
from gdp.intervals import LOOK_S, UPKEEP_S

_LOCK: Final = "supervisor.lock"
LOG: Final = "supervisor.log"
_LOG_MAX_BYTES: Final = 4 << 20


def is_running(site: Site) -> bool:
    """Return whether a supervisor of this site runs."""
    with (site.state / _LOCK).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def pid_of(site: Site) -> int | None:
    """Return the process id of the running supervisor; None: there is none."""
    if not is_running(site):
        return None
    with suppress(OSError, ValueError):
        return int((site.state / _LOCK).read_text(encoding="ascii"))
    return None


def ensure(site: Site) -> bool:
    """Start a supervisor if none runs; return whether one was started.

    This process acquires the lock and the child inherits it, so only one of several concurrent callers starts it.
    """
    with (site.state / _LOCK).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        path = site.state / LOG
        if path.exists() and path.stat().st_size > _LOG_MAX_BYTES:
            path.replace(path.with_suffix(".log.1"))
        with path.open("ab") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "fog.cli.app", "supervise", "--lock", str(lock.fileno()), *_of(site)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
                pass_fds=[lock.fileno()],
            )
    threading.Thread(target=process.wait, name="reaps the supervisor", daemon=True).start()
    return True


def _of(site: Site) -> list[str]:
    return ["--state", str(site.state), *([] if site.file is None else ["--site", str(site.file)])]


@contextmanager
def held(site: Site, descriptor: int | None) -> Iterator[None]:
    """Hold the supervisor's lock within the context; this process is then the supervisor.

    Raises:
        LocalError: another process holds it.
    """
    if descriptor is not None:
        with os.fdopen(descriptor, "a"):
            _sign(site)
            yield
        return
    with (site.state / _LOCK).open("a") as file:
        end_s = time.monotonic() + UPKEEP_S  # the lock is held for a check, or by another supervisor
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= end_s:
                    raise LocalError(f"a supervisor of {site.state} lives already") from error
                time.sleep(LOOK_S)
        _sign(site)
        yield


def _sign(site: Site) -> None:
    (site.state / _LOCK).write_text(f"{os.getpid()}\n", encoding="ascii")
