"""Network namespaces held by files: creation, entry and release.

I/O; needs CAP_SYS_ADMIN in the user namespace of the process. If the kernel refuses, a call raises ``LocalError``.
Source: network_namespaces(7), setns(2). A namespace is bound to a file, as in ip-netns(8). For root of the machine the
file lies in ``/run/netns``, so that ``ip netns`` finds it. Inside a user namespace that folder may be missing or
closed. Then the file lies in the run's own directory, and ``nsenter --net=FILE`` enters it.

The binding exists in the mount namespace of its maker alone, and each ``ip netns exec`` makes a mount namespace of its
own. So ``reach`` looks for the file in those of other processes, too.
"""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar

from gdp.errors import LocalError
from gdp.host.mounts import roots, unmount
from gdp.host.processes import Process
from gdp.ports.sockets import AS_ROOT

IP_NETNS_DIRECTORY: Final = Path("/run/netns")
_NO_IPV6: Final = ("all", "default")
_OWN: Final = Path("/proc/self/ns/net")
_IPV6_SETTINGS: Final = Path("/proc/sys/net/ipv6/conf")

T = TypeVar("T")


def create(path: Path) -> None:
    """Make a network namespace and bind it to the new file ``path``."""
    from pyroute2 import netns  # takes 0.2 s to load, which callers that only need the file avoid

    try:
        netns.create(str(path))
    except OSError as error:
        is_refused = error.errno in (errno.EPERM, errno.EACCES)
        why = f"not permitted; {AS_ROOT}" if is_refused else str(error)
        raise LocalError(f"network namespace {path.name} cannot be made: {why}") from error


def reach(path: Path) -> Path | None:
    """Return the path by which this process reaches the namespace of a file, whichever mount namespace binds it.

    Returns:
        None: the namespace is gone, or no process that this user may inspect has it bound.
    """
    device = _OWN.stat().st_dev
    for root in roots():
        with suppress(OSError):  # the process has ended, or its root has no such file
            found = root / path.relative_to("/")
            if found.stat().st_dev == device:
                return found
    return None


def inside(path: Path, work: Callable[[], T]) -> T:
    """Do ``work`` in a thread that has entered the namespace, and return its result; the caller's thread stays outside.

    Raises:
        OSError: the namespace does not exist, or ``work`` raises it.
    """
    from pyroute2 import netns

    results: list[T] = []
    failures: list[BaseException] = []

    def visit() -> None:
        """Enter the namespace and do the work."""
        try:
            descriptor = os.open(reach(path) or path, os.O_RDONLY | os.O_CLOEXEC)
            try:
                netns.setns(descriptor)
            finally:
                os.close(descriptor)
            results.append(work())
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=visit, name=f"inside {path.name}")
    thread.start()
    thread.join()
    if failures:
        raise failures[0]
    return results[0]


def processes_inside(paths: Collection[Path]) -> list[Process]:
    """Return the processes in these namespaces that this user may inspect; files without a namespace are skipped."""
    reached = filter(None, map(reach, paths))
    held = {where for path in reached if (where := _identity(path)) is not None}
    found = []
    for folder in Path("/proc").iterdir() if held else ():
        if folder.name.isdecimal() and _identity(folder / "ns" / "net") in held:
            with suppress(ProcessLookupError):
                found.append(Process.from_pid(int(folder.name)))
    return found


def release(path: Path) -> None:
    """Unbind the namespace and delete its file; the kernel frees it with its last process. No error if it is gone."""
    unmount(path)
    if path.parent != IP_NETNS_DIRECTORY:
        unmount(path.parent)  # ``create`` bound the folder onto itself, as ip-netns(8) does
    path.unlink(missing_ok=True)


def _identity(path: Path) -> tuple[int, int] | None:
    """Return a value that identifies a namespace; None if there is none, or this user may not inspect it."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def disable_ipv6() -> None:
    """Disable IPv6 in the current namespace; called before its first device, this prevents neighbour solicitations."""
    for scope in _NO_IPV6:
        setting = _IPV6_SETTINGS / scope / "disable_ipv6"
        if setting.exists() and os.access(setting, os.W_OK):  # containers may have it read-only
            setting.write_text("1", encoding="ascii")
