"""Control group: bounds on the resources of a set of processes, which can also be frozen or killed together.

I/O; needs writable cgroups, which containers and plain users often lack. It supports both versions, also at the same
time: a bound is set in the version that has its file.
Source: cgroups(7); Linux, Documentation/admin-guide/cgroup-v2.rst (cpu.max, cpu.weight, memory.max, cgroup.freeze,
cgroup.kill) and cgroup-v1/ (cpu.cfs_quota_us, cpu.shares, memory.limit_in_bytes).
"""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.mounts import roots
from gdp.intervals import LOOK_S, STOP_S

_OLD_CONTROLLERS: Final = frozenset({"cpu", "memory"})
_PERIOD_US: Final = 20_000  # a fifth of the kernel's default, so that a slow machine runs evenly
_LEAST_US: Final = 1_000  # the kernel accepts no quota below this
_LONGEST_PERIOD_US: Final = 1_000_000
_WEIGHT, _SHARES = 100, 1_024  # of one core: the defaults of a group
_GONE: Final = (errno.ENOENT, errno.ENODEV)


class Cgroup:
    """The group called ``name`` directly below each usable root.

    The constructor makes no group; see ``make``. The other methods raise ``LocalError`` if the kernel
    refuses, or if this host has no such bound.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._new, old = _roots()
        self._folders = {kind: root / name for kind, root in old.items()}
        if self._new is not None:
            self._folders["all"] = self._new / name

    def make(self) -> bool:
        """Make the group; return whether every bound can be set.

        If no hierarchy is writable, the group stays empty.
        """
        for kind, folder in list(self._folders.items()):
            try:
                folder.mkdir(exist_ok=True)
            except OSError:  # read-only or owned by another user: continue without this one
                del self._folders[kind]
        if self._new is not None and "all" in self._folders:
            for controller in sorted(_OLD_CONTROLLERS - self._folders.keys()):
                with suppress(OSError):  # version 1 has it, or the root has processes: the missing file shows it
                    (self._new / "cgroup.subtree_control").write_text(f"+{controller}")
        return all(map(self._find, (("cpu.max", "cpu.cfs_quota_us"), ("memory.max", "memory.limit_in_bytes"))))

    def add(self, pid: int) -> None:
        """Add a process; the processes that it starts later join the group, too."""
        for folder in self._standing():
            self._write(folder / "cgroup.procs", str(pid))

    def limit_cpu(self, cpus: float | None) -> None:
        """Limit the group to the time of ``cpus`` processors; None: no limit."""
        period_us = _PERIOD_US
        if cpus is not None and cpus * period_us < _LEAST_US:
            period_us = min(int(_LEAST_US / cpus), _LONGEST_PERIOD_US)
        quota_us = None if cpus is None else max(int(cpus * period_us), _LEAST_US)
        path = self._find(("cpu.max", "cpu.cfs_quota_us"))
        if path is None:
            raise LocalError(f"the group {self.name} has no bound on processor time here")
        if path.name == "cpu.max":
            self._write(path, f"{'max' if quota_us is None else quota_us} {period_us}")
        else:
            self._write(path.with_name("cpu.cfs_period_us"), str(period_us))
            self._write(path, str(-1 if quota_us is None else quota_us))

    def share_cpu(self, cores: int) -> None:
        """Weight the group by ``cores``: where groups compete for processors, they get time in this proportion."""
        path = self._find(("cpu.weight", "cpu.shares"))
        if path is None:
            raise LocalError(f"the group {self.name} has no weight of processor time here")
        self._write(path, str(cores * (_WEIGHT if path.name == "cpu.weight" else _SHARES)))

    def limit_memory(self, size_bytes: int | None) -> None:
        """Limit the group's memory; the kernel kills processes in it that exceed the limit; None: no limit."""
        path = self._find(("memory.max", "memory.limit_in_bytes"))
        if path is None:
            raise LocalError(f"the group {self.name} has no bound on memory here")
        nothing = "max" if path.name == "memory.max" else "-1"
        self._write(path, nothing if size_bytes is None else str(size_bytes))

    def set_frozen(self, *, held: bool) -> bool:
        """Freeze all processes, or resume them; return whether this host can do that."""
        path = self._find(("cgroup.freeze",))
        if path is not None:
            self._write(path, "1" if held else "0")
        return path is not None

    def kill(self) -> None:
        """Kill every process of the group; no error if another process removes it in the meantime."""
        if (path := self._find(("cgroup.kill",))) is not None:
            try:
                path.write_text("1", encoding="ascii")
            except OSError as error:
                if error.errno not in _GONE:
                    raise LocalError(f"{path}: {error.strerror}") from error
            return
        for folder in self._standing():
            for pid in _pids(folder):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    def remove(self) -> None:
        """Kill the remaining processes of the group, and remove it with the groups in it; no error if it is gone."""
        end_s = time.monotonic() + STOP_S
        for folder in self._standing():
            while True:
                self.kill()  # in the loop: without cgroup.kill, a process may have started another
                try:
                    for nested in sorted(folder.rglob("*/"), reverse=True):  # made by its processes, as by systemd
                        if nested.is_dir():  # Python before 3.11 returns files, too
                            nested.rmdir()
                    folder.rmdir()
                    break
                except FileNotFoundError:
                    if not folder.exists():
                        break
                except OSError as error:  # busy until the last process ends, which version 1 does not report
                    if time.monotonic() > end_s:
                        raise LocalError(f"{folder} cannot be removed: {error.strerror}") from error
                    time.sleep(LOOK_S)

    def _standing(self) -> list[Path]:
        return [folder for folder in self._folders.values() if folder.is_dir()]

    def _find(self, names: tuple[str, ...]) -> Path | None:
        paths = (folder / name for folder in self._folders.values() for name in names)
        return next((path for path in paths if path.exists()), None)

    def _write(self, path: Path, text: str) -> None:
        try:
            path.write_text(text, encoding="ascii")
        except OSError as error:
            raise LocalError(f"{path}: {text}: {error.strerror}") from error


def _pids(folder: Path) -> Iterator[int]:
    with suppress(OSError):  # removed in the meantime
        yield from map(int, (folder / "cgroup.procs").read_text(encoding="ascii").split())


def _roots() -> tuple[Path | None, dict[str, Path]]:
    """Return the root of version 2, and the roots of version 1 by controller."""
    new, old = None, dict[str, Path]()
    for root in roots():  # ``ip netns exec`` mounts a /sys without control groups
        process = Path("/proc/self") if root == Path("/") else root.parent
        with suppress(OSError):  # the process has ended
            for line in (process / "mounts").read_text(encoding="utf-8", errors="replace").splitlines():
                _, place, kind, options, *_ = line.split()
                folder = root / place.removeprefix("/")
                if kind == "cgroup2":
                    new = new or folder
                elif kind == "cgroup":
                    old.update(dict.fromkeys(_OLD_CONTROLLERS.intersection(options.split(",")), folder))
        if new is not None or old:
            break
    return new, old
