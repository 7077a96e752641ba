"""Named network namespace of a run, and the command lines that run a program inside it.

I/O; needs CAP_SYS_ADMIN. The run's record names the namespace before it is made; ``run.end()`` removes it.
"""

from __future__ import annotations

import contextlib
import select
from collections.abc import Callable, Sequence
from typing import Final, TypeVar

from gdp.errors import LocalError
from gdp.host import netns_files
from gdp.host.run_registry import Run, in_first_user_namespace
from gdp.ports.rtnetlink import LinkMonitor

_PATIENCE_S: Final = 10.0

T = TypeVar("T")


class Namespace:
    """A network namespace.

    Args:
        label: part of its name; unique in the run.

    Attributes:
        path: the file that holds it.

    Raises:
        LocalError: the kernel refuses.
    """

    def __init__(self, run: Run, label: str) -> None:
        folder = netns_files.IP_NETNS_DIRECTORY if in_first_user_namespace() else run.directory / "netns"
        self.path = folder / f"gdp-{run.id}-{label}"
        run.plan_namespace(self.path)
        netns_files.create(self.path)

    def inside(self, work: Callable[[], T]) -> T:
        """Call ``work`` in a thread inside, and return its result; a socket made there stays there."""
        return netns_files.inside(self.path, work)

    def command(self, argv: Sequence[str], *, dies_with_us: bool = True) -> list[str]:
        """Return the command line that runs ``argv`` inside, under the same process id.

        Args:
            dies_with_us: whether the kernel kills it when the thread that starts it ends in any way.
        """
        leash = ["setpriv", "--pdeathsig", "KILL", "--"] if dies_with_us else []
        return ["nsenter", f"--net={self.path}", "--", *leash, *argv]


def wait_for_carrier(*devices: str) -> None:
    """Return when these devices of the thread's namespace can send. Raises ``LocalError``: they do not get so far."""
    with contextlib.closing(LinkMonitor()) as monitor:
        while not all(link is not None and link.up for link in map(monitor.get, devices)):
            if not select.select([monitor], [], [], _PATIENCE_S)[0]:
                raise LocalError(f"no carrier at {', '.join(devices)}")
            monitor.poll()
