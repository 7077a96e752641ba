"""One supervisor a site, in the background: started where none lives, known by a lock that the kernel ends with it.

Place: shell.
"""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Final

from fog.site import Site
from fog.supervisor.decide import Patience
from fog.supervisor.ground import command_of, open_provider, stand
from fog.supervisor.journal import Journal
from fog.supervisor.supervisor import Supervisor
from fog.supervisor.watch import Watch
from gdp.errors import LocalError, StoreError

__all__ = ["LOG", "ensure", "is_running", "pid_of", "supervise"]

log = logging.getLogger(__name__)

_LOCK: Final = "supervisor.lock"
LOG: Final = "supervisor.log"
_LOG_MAX_BYTES: Final = 4 << 20
_ELSEWHERE_S: Final = 900.0  # a machine of a cloud has an image to boot and packages to install
_RIVAL_S: Final = 1.0  # the lock is held by whoever looks, or by another supervisor
_STEP_S: Final = 0.05
_DONE_S: Final = 2.0  # nothing is wanted for so long: it ends


def is_running(site: Site) -> bool:
    """Return whether a supervisor of this site lives."""
    with (site.state / _LOCK).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def pid_of(site: Site) -> int | None:
    """Return the process id of the supervisor that lives."""
    if not is_running(site):
        return None
    with suppress(OSError, ValueError):
        return int((site.state / _LOCK).read_text(encoding="ascii"))
    return None


def ensure(site: Site) -> bool:
    """Start a supervisor if none lives; return whether one was started.

    The lock is taken here and handed down, so that of many who ask at once one starts it.
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


def supervise(site: Site, *, stays: bool = False, lock: int | None = None) -> None:
    """Be the supervisor, until SIGTERM or, unless ``stays``, until nothing is wanted any more.

    Args:
        lock: descriptor of the lock, where it was taken already.

    Raises:
        LocalError: another one lives, or the provider cannot be had.
    """
    with _locked(site, lock):
        (site.state / _LOCK).write_text(f"{os.getpid()}\n", encoding="ascii")
        with closing(Journal(site.journal)) as journal:
            _run(site, journal, stays=stays)


def _run(site: Site, journal: Journal, *, stays: bool) -> None:
    ended = threading.Event()
    watch = Watch(*site.watch) if site.watch is not None else None
    regions = _regions(journal)
    provider = open_provider(site, regions)
    supervisor = Supervisor(
        site,
        journal,
        provider,
        partial(command_of, site),
        watch.heard if watch is not None else lambda: None,
        watch.reload if watch is not None else lambda: None,
        Patience() if provider.name == "local" else Patience(boot_s=_ELSEWHERE_S),
    )

    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        ended.set()
        supervisor.wake()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, end)
    log.info("supervisor begins site=%s provider=%s pid=%d", site.state, provider.name, os.getpid())
    done_at_s: float | None = None
    try:
        if any(each.is_up for each in journal.clusters()):
            stand(site)  # after a crash of this machine nothing stands
        while not ended.is_set():
            try:
                if (now := _regions(journal)) != regions:
                    regions = now
                    supervisor.use(open_provider(site, regions))
                supervisor.look()
                is_done = supervisor.is_done and not stays
            except StoreError as error:
                log.error("look failed reason=%s", error)
                is_done = False
            if not is_done:
                done_at_s = None
            elif done_at_s is None:
                done_at_s = time.monotonic()
            elif time.monotonic() - done_at_s >= _DONE_S:
                break
            supervisor.wait()
    finally:
        supervisor.close()
        if watch is not None:
            watch.close()
        provider.close()
    log.info("supervisor ends")


def _regions(journal: Journal) -> tuple[str, ...]:
    wanted = (each for cluster in journal.clusters() for each in cluster.plan.machines)
    return tuple(dict.fromkeys(each.region for each in wanted if each.region))


def _of(site: Site) -> list[str]:
    return ["--state", str(site.state), *([] if site.file is None else ["--site", str(site.file)])]


@contextmanager
def _locked(site: Site, descriptor: int | None) -> Iterator[None]:
    """Hold the supervisor's lock while within.

    Raises:
        LocalError: another one has it.
    """
    if descriptor is not None:
        with os.fdopen(descriptor, "a"):
            yield
        return
    with (site.state / _LOCK).open("a") as file:
        end_s = time.monotonic() + _RIVAL_S
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() >= end_s:
                    raise LocalError(f"a supervisor of {site.state} lives already") from error
                time.sleep(_STEP_S)
        yield
