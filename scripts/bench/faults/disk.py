"""Small disk of the RIBs' snapshots, which can be filled, and what RIBs must log of it. I/O."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gdp.host.mounts import mount_tmpfs
from gdp.host.run_registry import Run

SIZE_BYTES: Final = 64 << 20  # six snapshots with their logs take 30 MB at most
NOT_WRITTEN: Final = "snapshot not written"
_WRITTEN: Final = "snapshot written again"
_READ: Final = "snapshot read"
_NOT_READ: Final = "snapshot not read"
_UP: Final = "rib up"
BROKEN: Final = ".broken"
_BLOCKS_BYTES: Final = (1 << 20, 1 << 12)


class Disk:
    """Small file system.

    ``run``: run whose folder holds the mount, and whose end unmounts it. Raises ``LocalError``: the kernel refuses.
    """

    def __init__(self, run: Run) -> None:
        self._path = run.directory / "disk"
        run.plan_mount(self._path)
        mount_tmpfs(self._path, SIZE_BYTES)

    @property
    def _ballast(self) -> Path:
        return self._path / "ballast"

    def snapshot(self, node: str) -> Path:
        """Return the path of the snapshot of the RIB at a switch."""
        return self._path / f"rib-{node}.sqlite"

    def fill(self) -> None:
        """Fill every block."""
        with self._ballast.open("wb", buffering=0) as file:
            for size in _BLOCKS_BYTES:
                try:
                    while True:
                        file.write(bytes(size))
                except OSError as error:
                    if error.errno != errno.ENOSPC:
                        raise

    def free(self) -> None:
        """Free the blocks."""
        self._ballast.unlink(missing_ok=True)

    def broken(self) -> list[str]:
        """Return the snapshots that a RIB could not read."""
        return sorted(name for name in os.listdir(self._path) if name.endswith(BROKEN))


def snapshot_faults(who: str, log: str, *, is_alive: bool) -> Iterator[str]:
    """Yield, in words, what an incarnation of a RIB logged wrongly about its snapshot.

    ``log``: its whole log. ``is_alive``: it runs, the disk has free space, and it had enough time to write.
    """
    is_failing = has_started = False
    for line in log.splitlines():
        if _UP in line and not has_started:
            yield f"{who} is up and did not say what it read of its snapshot"
        elif _READ in line or _NOT_READ in line:
            has_started = True
            if _READ in line and " unreadable=0 " not in line:
                yield f"{who} read half an entry: {line}"
        elif NOT_WRITTEN in line:
            if is_failing:
                yield f"{who} said twice that its snapshot is not written"
            is_failing = True
        elif _WRITTEN in line:
            is_failing = False
    if is_failing and is_alive:
        yield f"{who} does not write its snapshot again, or does not say so"
