"""Run registry: a record of the resources of each run, so that a later start can remove those of a killed run.

I/O. A record is written *before* the resource that it names is made, and it is replaced atomically. So it may name
resources that were never made, but it never misses one. It lies in ``/run/gdp``, or without root in
``$XDG_RUNTIME_DIR/gdp``.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.cgroups import Cgroup
from gdp.host.mounts import unmount
from gdp.host.processes import Process, boot_id, end_all
from gdp.intervals import FORGET_S
from gdp.stores.ownership import refuse_foreign_folder

log = logging.getLogger(__name__)

_ID_BYTES: Final = 3
_WRITE: Final = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
_FRESH: Final = ".new"  # of a record that is being written
_ALL_IDS: Final = 4_294_967_295  # length of the first user namespace's map; user_namespaces(7)


def in_first_user_namespace() -> bool:
    """Return whether root here is root of the machine, not of a user namespace."""
    return int(_uid_map()[2]) == _ALL_IDS


def outer_uid() -> int:
    """Return this user's id outside any user namespace."""
    inside, outside, _ = map(int, _uid_map()[:3])
    return os.getuid() - inside + outside


def _uid_map() -> list[str]:
    return Path("/proc/self/uid_map").read_text(encoding="ascii").split()


@dataclass(slots=True, kw_only=True)
class Record:
    """Resources of one run.

    ``owner`` is the process that is responsible for it; a kept run exists without one.
    """

    run: str
    boot: str
    owner: Process
    kept: bool = False
    processes: list[Process] = field(default_factory=list)
    namespaces: list[str] = field(default_factory=list)  # paths of files that hold a network namespace
    files: list[str] = field(default_factory=list)  # files and directories to delete
    cgroups: list[str] = field(default_factory=list)  # names
    mounts: list[str] = field(default_factory=list)  # paths that a file system is mounted on
    passive: bool = False  # kept, and without a process whose end would end it

    @classmethod
    def from_text(cls, text: str) -> Record:
        """Read the text of ``to_text``. Raises ``ValueError``: it is something else."""
        try:
            items = json.loads(text)
            items["owner"] = Process(**items["owner"])
            items["processes"] = [Process(**process) for process in items["processes"]]
            return cls(**items)
        except (KeyError, TypeError) as error:
            raise ValueError(f"not the record of a run: {error}") from error

    def to_text(self) -> str:
        """Return the record as JSON."""
        return json.dumps(asdict(self), indent=1)

    @property
    def dead(self) -> bool:
        """Return whether no live process is responsible for the run."""
        if self.boot != boot_id():
            return True
        if self.kept and self.passive:
            return False
        return not any(process.alive for process in (self.processes if self.kept else [self.owner]))


class Run:
    """An active run: a scratch directory of its own, and a record that grows with its resources.

    Attributes:
        record: the resources recorded until now.
    """

    def __init__(self, record: Record, path: Path, directory: Path) -> None:
        self.record = record
        self._path = path
        self.directory = directory
        self._save()
        directory.mkdir(mode=0o700)

    @classmethod
    def resumed(cls, record: Record, path: Path) -> Run:
        """Return the run of an existing record."""
        run = cls.__new__(cls)
        run.record, run._path, run.directory = record, path, Path(record.files[0])
        return run

    @property
    def id(self) -> str:
        """Return the id of the run, six hex digits."""
        return self.record.run

    def plan_namespace(self, path: Path) -> None:
        """Record a namespace that is about to be made."""
        self.record.namespaces.append(str(path))
        self._save()

    def plan_cgroup(self, name: str) -> None:
        """Record a control group that is about to be made."""
        self.record.cgroups.append(name)
        self._save()

    def plan_mount(self, path: Path) -> None:
        """Record a path that a file system is about to be mounted on."""
        self.record.mounts.append(str(path))
        self._save()

    def note_process(self, pid: int) -> None:
        """Record a process that was just started as the leader of its group, unless it has already ended."""
        with suppress(ProcessLookupError):
            self.record.processes.append(Process.from_pid(pid))
            self._save()

    def retain(self, *, passive: bool = False) -> None:
        """Keep all resources after this process ends, until ``RunRegistry.take_down``.

        Args:
            passive: the run has namespaces and devices only; it is dead after a reboot, and never before.
        """
        self.record.kept = True
        self.record.passive = passive
        self._save()

    def end(self) -> None:
        """Remove everything that the record names, and the record."""
        _take_down(self.record, self._path)

    def _save(self) -> None:
        fresh = self._path.with_suffix(_FRESH)
        try:
            descriptor = os.open(fresh, _WRITE, 0o600)
        except FileNotFoundError:  # another run ended, and took the empty directory with it
            _make_directory(fresh.parent)
            descriptor = os.open(fresh, _WRITE, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(self.record.to_text())
        fresh.replace(self._path)


class RunRegistry:
    """The directory of records of one user.

    Args:
        directory: of the records; by default the run-time directory of this user.

    Raises:
        LocalError: the directory belongs to another user, or others may write to it.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._directory = directory or _default_directory()
        _make_directory(self._directory)

    def start(self) -> Run:
        """Begin a run with a new id and an empty scratch directory (in the directory for temporary files)."""
        run = secrets.token_hex(_ID_BYTES)
        directory = Path(tempfile.gettempdir()) / f"gdp-{run}"
        record = Record(run=run, boot=boot_id(), owner=Process.from_pid(os.getpid()), files=[str(directory)])
        return Run(record, self._directory / f"{run}.json", directory)

    def all(self) -> list[Record]:
        """Return the record of every run."""
        return [record for record, _ in self._records()]

    def resume(self, run: str) -> Run:
        """Resume a run that was kept, to add to it or to end it; or a dead one, to end it.

        Raises:
            LocalError: there is no such run, or its owner is alive.
        """
        for record, path in self._records():
            if record.run == run and (record.kept or record.dead):
                return Run.resumed(record, path)
        raise LocalError(f"no run {run} to go on with")

    def sweep(self) -> list[str]:
        """Remove every dead run; return their ids."""
        self._remove_unfinished()
        return [record.run for record, path in self._records() if record.dead and _take_down(record, path)]

    def take_down(self) -> list[str]:
        """Remove every kept and every dead run; return their ids. Active runs stay."""
        return [r.run for r, path in self._records() if (r.kept or r.dead) and _take_down(r, path)]

    def _remove_unfinished(self) -> None:
        """Remove half-written records of processes that were killed before they made a resource."""
        for path in self._directory.glob(f"*{_FRESH}"):
            with suppress(FileNotFoundError):  # it was renamed, or another process removed it first
                if time.time() - path.stat().st_mtime > FORGET_S and not path.with_suffix(".json").exists():
                    path.unlink()

    def _records(self) -> list[tuple[Record, Path]]:
        found = []
        for path in sorted(self._directory.glob("*.json")):
            try:
                found.append((Record.from_text(path.read_text(encoding="utf-8")), path))
            except FileNotFoundError:
                continue  # another process removed it first
            except ValueError as error:
                log.warning("record left alone path=%s reason=%s", path, error)
        return found


def _make_directory(path: Path) -> None:
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    refuse_foreign_folder(path, "it names what will be deleted")


def _default_directory() -> Path:
    if in_first_user_namespace() and os.getuid() == 0:
        return Path("/run/gdp")
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and os.access(runtime, os.W_OK):
        return Path(runtime) / "gdp"
    return Path(tempfile.gettempdir()) / f"gdp-runs-{outer_uid()}"


def _take_down(record: Record, path: Path) -> bool:
    """Remove what the record names; resources that are already gone are skipped."""
    # pyroute2 takes 0.2 s to load, and most records need none of it
    from gdp.host.netns_files import processes_inside, release

    if record.boot == boot_id():
        end_all(record.processes)
        spaces = [Path(namespace) for namespace in record.namespaces]
        end_all(processes_inside(spaces), are_leaders=False)  # daemons that were not recorded in time
        for group in record.cgroups:
            Cgroup(group).remove()
        for space in spaces:
            release(space)
        for mount in record.mounts:
            unmount(Path(mount))
    for name in record.files:
        target = Path(name)
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target, onerror=_unless_gone)
        else:
            target.unlink(missing_ok=True)
    path.with_suffix(_FRESH).unlink(missing_ok=True)
    path.unlink(missing_ok=True)
    if path.parent.parent == Path(tempfile.gettempdir()):
        with suppress(OSError):  # another run has a record there
            path.parent.rmdir()
    return True


def _unless_gone(_function: object, _path: str, failure: tuple[type, BaseException, object]) -> None:
    """Go on if another process removed a file of the folder first; else the rest would stay, and without a record."""
    if not isinstance(failure[1], FileNotFoundError):
        raise failure[1]
