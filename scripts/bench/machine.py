"""State of the machine that a bench ran on, and preconditions of a page: its data are there, it can be trusted.

I/O. Reads /proc.

    state = machine_state()                            call it first: it also takes the load before the bench
"""

from __future__ import annotations

import os
import platform
import subprocess
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.crypto.keys import SigningKey

ROOT: Final = Path(__file__).resolve().parents[2]
_LOOPS, _PAIRS = 10_000_000, 1_000
_SCHEDULED: Final = 2  # CPUCLOCK_SCHED, in ns


@dataclass(frozen=True, slots=True)
class MachineState:
    """State of the machine before a bench, and the code that it ran.

    Attributes:
        load_before: runnable processes, mean over the last minute.
        commit: of the code, with ``-dirty`` after it where the code differs from it; empty: not known.
        date: of the bench, in UTC, such as 2026-11-28; empty: not known.
        is_timed: other work changes the figures; not so those of a virtual clock.
    """

    kernel: str
    processor: str
    cores: int
    python: str
    load_before: float
    commit: str = ""
    date: str = ""
    is_timed: bool = True

    @property
    def is_busy(self) -> bool:
        """Return whether other work took more than half of the cores, and matters."""
        return self.is_timed and self.load_before > self.cores / 2

    @property
    def mark(self) -> str:
        """Return what is added to the label of each row: the load of a busy machine, or nothing."""
        return f" (load {self.load_before:.1f})" if self.is_busy else ""

    def __str__(self) -> str:
        return (
            f"Linux {self.kernel}, {self.cores} cores ({self.processor}), Python {self.python},"
            f" load before {self.load_before:.2f}, {self.code}"
        )

    @property
    def code(self) -> str:
        """Return day and commit, in words."""
        return f"{self.date}, commit {self.commit}" if self.commit else "day and commit not recorded"


def machine_state() -> MachineState:
    """Read the state of the machine; only the cores that this process may use are counted."""
    return MachineState(
        platform.release(),
        _processor(),
        len(os.sched_getaffinity(0)),
        platform.python_version(),
        os.getloadavg()[0],
        _commit(),
        time.strftime("%Y-%m-%d", time.gmtime()),
    )


def calibration() -> dict[str, float]:
    """Return the seconds of fixed work, by which figures of two machines compare: 0.7 s on a Xeon of 2.5 GHz."""
    begun_s = time.perf_counter()
    for _ in range(_LOOPS):
        pass
    looped_s = time.perf_counter() - begun_s
    loops, pairs = f"loop of {_LOOPS:,} in Python, s", f"{_PAIRS:,} ECDSA signatures and checks, s"
    return {loops: round(looped_s, 3), pairs: round(_PAIRS * signature_pair_s(_PAIRS), 3)}


def signature_pair_s(pairs: int = 100) -> float:
    """Return the seconds of one ECDSA signature and its check: the mean of ``pairs``."""
    key, begun_s = SigningKey.generate(), time.perf_counter()
    for each in range(pairs):
        digest = each.to_bytes(32, "big")
        key.public.verify_digest(key.sign_digest(digest), digest)
    return (time.perf_counter() - begun_s) / pairs


def git(*words: str, root: Path = ROOT) -> str:
    """Return the output of a git command in a repository, by default this one, also where another user owns it.

    Raises:
        OSError: there is no git.
        subprocess.CalledProcessError: the command failed, or this is no repository.
    """
    argv = ["git", "-C", str(root), "-c", "safe.directory=*", *words]
    environment = {**os.environ, "GIT_CEILING_DIRECTORIES": str(root.parent)}  # one around this folder is another one
    return subprocess.run(argv, capture_output=True, text=True, check=True, env=environment).stdout.strip()


def _commit() -> str:
    """Return the commit of the code; measured pages do not count as changes."""
    try:
        commit = git("rev-parse", "--short=12", "HEAD")
        return f"{commit}-dirty" if git("status", "--porcelain", "--", ".", ":!docs") else commit
    except (OSError, subprocess.CalledProcessError):
        return ""


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Model"):
            return value.strip()
    return platform.machine()


def processor_s(pid: int) -> float:
    """Return the processor time of a process, of all its threads and of the system in their name.

    Source: Linux, include/linux/posix-timers.h, ``MAKE_PROCESS_CPUCLOCK``.
    """
    return time.clock_gettime(~pid << 3 | _SCHEDULED)


DATA: Final = ROOT / "scripts" / "data"


class RefusedError(Exception):
    """A command cannot begin; the text says what is wrong and what to do."""


def data_folder(name: str, patterns: Iterable[str], within: Path = DATA) -> Path:
    """Return a folder of recorded data, such as ``spot``; at least one file matches each pattern.

    Raises ``RefusedError``: none does.
    """
    folder = within / name
    for pattern in patterns:
        if not any(folder.glob(pattern)):
            does = "scripts/data/fetch.sh fetches" if name == "planning" else "git checkout -- scripts/data restores"
            raise RefusedError(f"no {folder / pattern}: {does} it")
    return folder


def require_trust(state: MachineState, *, allow_load: bool) -> None:
    """Refuse to measure for a page that could not name its commit, or whose machine does other work.

    ``allow_load``: the rows are marked instead. Raises ``RefusedError``: such a page.
    """
    if not state.commit:
        raise RefusedError(f"a page names its commit, and {ROOT} is no git repository: clone it by git, or use --quick")
    if state.is_busy and not allow_load:
        raise RefusedError(
            f"the load before, {state.load_before:.2f}, exceeds half of {state.cores} cores:"
            " wait for a quiet machine, or mark each row by --allow-load"
        )


def require_writable(folder: Path) -> None:
    """Make a folder, and write a file into it for a moment. Raises ``RefusedError``: it cannot be made or written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise RefusedError(f"{folder} cannot be written ({error.strerror}): choose another folder") from error
