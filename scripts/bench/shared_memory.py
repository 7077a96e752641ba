"""Shared memory of one machine of a lab: a ``/dev/shm`` that only the processes of that machine see.

I/O; needs root of the machine or of a user namespace.
A file system in memory lies in the run's folder. Each process of the machine runs in a mount namespace, in which that
file system is mounted on ``/dev/shm``. So processes of one machine share memory, and those of two machines do not. The
run's record names the mount, so that ``run.end()`` removes it, or a sweep after the run was killed.
Source: shm_overview(7), mount_namespaces(7), unshare(1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gdp.host.mounts import mount_tmpfs
from gdp.host.run_registry import Run

_SIZE_BYTES: Final = 256 << 20  # a limit, not a reservation
_ENTER: Final = 'mount --bind "$0" /dev/shm && exec "$@"'


class SharedMemory:
    """The ``/dev/shm`` of a machine.

    Raises:
        LocalError: the kernel refuses.
    """

    def __init__(self, run: Run, node: str) -> None:
        self.folder = run.directory / f"shm-{node}"
        run.plan_mount(self.folder)
        mount_tmpfs(self.folder, _SIZE_BYTES)

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` with this ``/dev/shm``, under the same process id."""
        return ["unshare", "--mount", "--propagation", "private", "--", "sh", "-c", _ENTER, str(self.folder), *argv]
