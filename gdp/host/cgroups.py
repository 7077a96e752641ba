"""A control group: a bound on what a set of processes takes, and a hand that holds or kills all of them at once.

Place: shell; needs writable cgroups, which containers and plain users often lack. Both versions are served, also side
by side: a bound is set wherever its file is found.
Source: cgroups(7); Linux, Documentation/admin-guide/cgroup-v2.rst (cpu.max, memory.max, cgroup.freeze, cgroup.kill) and
cgroup-v1/ (cpu.cfs_quota_us, memory.limit_in_bytes).
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

__all__ = ["Cgroup"]

_MOUNTS: Final = Path("/proc/self/mounts")
_OLD_CONTROLLERS: Final = frozenset({"cpu", "memory"})
_PERIOD_US: Final = 20_000  # a fifth of the kernel's own, so that a slow machine is slow rather than jerky
_LEAST_US: Final = 1_000  # the kernel takes no quota below this
_LONGEST_PERIOD_US: Final = 1_000_000
_PATIENCE_S: Final = 3.0
_LOOK_S: Final = 0.005
_GONE: Final = (errno.ENOENT, errno.ENODEV)


class Cgroup:
    """The group called ``name`` directly below each root that has a use here. To name it makes nothing."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._new, old = _roots()
        self._folders = {kind: root / name for kind, root in old.items()}
        if self._new is not None:
            self._folders["all"] = self._new / name

    def make(self) -> bool:
        """Make the group; return whether every bound can be set. Where nothing can, no process is ever in it."""
        for kind, folder in list(self._folders.items()):
            try:
                folder.mkdir(exist_ok=True)
            except OSError:  # read-only or another's: without this one
                del self._folders[kind]
        if self._new is not None and "all" in self._folders:
            for controller in sorted(_OLD_CONTROLLERS - self._folders.keys()):
                with suppress(OSError):  # held by version 1, or processes are in the root: told by what is missing
                    (self._new / "cgroup.subtree_control").write_text(f"+{controller}")
        return all(map(self._find, (("cpu.max", "cpu.cfs_quota_us"), ("memory.max", "memory.limit_in_bytes"))))

    def add(self, pid: int) -> None:
        """Put a process in; what it starts from then on is in, too.

        Raises:
            LocalError: the kernel refuses.
        """
        for folder in self._standing():
            self._write(folder / "cgroup.procs", str(pid))

    def limit_cpu(self, cpus: float | None) -> None:
        """Let the group take as much time as ``cpus`` processors have; None: all.

        Raises:
            LocalError: there is no such bound here.
        """
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

    def limit_memory(self, size_bytes: int | None) -> None:
        """Let the group take this much memory, and the kernel kill in it what wants more; None: all there is.

        Raises:
            LocalError: there is no such bound here.
        """
        path = self._find(("memory.max", "memory.limit_in_bytes"))
        if path is None:
            raise LocalError(f"the group {self.name} has no bound on memory here")
        nothing = "max" if path.name == "memory.max" else "-1"
        self._write(path, nothing if size_bytes is None else str(size_bytes))

    def hold(self, *, held: bool) -> bool:
        """Stop all processes where they are, or let them go on; return whether that can be done here."""
        path = self._find(("cgroup.freeze",))
        if path is not None:
            self._write(path, "1" if held else "0")
        return path is not None

    def kill(self) -> None:
        """Kill every process of the group; fine if somebody else removes it meanwhile.

        Raises:
            LocalError: the kernel refuses.
        """
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
        """Kill what is left in the group, and remove it; fine if it is gone.

        Raises:
            LocalError: the kernel refuses.
        """
        end_s = time.monotonic() + _PATIENCE_S
        for folder in self._standing():
            while True:
                self.kill()  # again: without cgroup.kill, one may have started another meanwhile
                try:
                    folder.rmdir()
                    break
                except FileNotFoundError:
                    break
                except OSError as error:  # busy until the last one is gone, of which version 1 tells nobody
                    if time.monotonic() > end_s:
                        raise LocalError(f"{folder} cannot be removed: {error.strerror}") from error
                    time.sleep(_LOOK_S)

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
    with suppress(OSError):  # gone meanwhile
        yield from map(int, (folder / "cgroup.procs").read_text(encoding="ascii").split())


def _roots() -> tuple[Path | None, dict[str, Path]]:
    """Return where groups of version 2 are, and by controller where those of version 1 are."""
    new, old = None, {}
    for line in _MOUNTS.read_text(encoding="utf-8", errors="replace").splitlines():
        _, place, kind, options, *_ = line.split()
        if kind == "cgroup2":
            new = new or Path(place)
        elif kind == "cgroup":
            old.update({name: Path(place) for name in _OLD_CONTROLLERS.intersection(options.split(","))})
    return new, old
