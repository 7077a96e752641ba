"""Mounts of a run: file systems in memory, the removal of any mount, and what other mount namespaces show.

I/O; mounting needs CAP_SYS_ADMIN in the user namespace that owns the mount namespace. If the kernel
refuses, a call raises ``LocalError``.
Source: mount(2), umount2(2), tmpfs(5).
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.errors import LocalError

_MNT_DETACH: Final = 2
_NOTHING_THERE: Final = (errno.EINVAL, errno.ENOENT)


def mount_tmpfs(path: Path, size_bytes: int) -> None:
    """Make a folder and mount a file system of this size there."""
    path.mkdir(mode=0o700)
    libc = ctypes.CDLL(None, use_errno=True)
    options = f"size={size_bytes},mode=0700".encode()
    if libc.mount(b"tmpfs", os.fsencode(path), b"tmpfs", 0, options) != 0:
        raise LocalError(f"{path}: tmpfs cannot be mounted: {os.strerror(ctypes.get_errno())}")


def roots() -> Iterator[Path]:
    """Yield this process's root, then that of one process in each other mount namespace that this user may inspect.

    Each ``ip netns exec`` makes a mount namespace, with a /sys of its own.
    """
    yield Path("/")
    seen = {os.readlink("/proc/self/ns/mnt")}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is another user's
            space = os.readlink(process / "ns" / "mnt")
            if space not in seen:
                seen.add(space)
                yield process / "root"


def unmount(path: Path) -> None:
    """Unmount ``path``; no error if nothing is mounted there, since mounts end with their mount namespace."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.umount2(os.fsencode(path), _MNT_DETACH) != 0:
        reason = ctypes.get_errno()
        if reason not in _NOTHING_THERE:
            raise LocalError(f"{path} cannot be unmounted: {os.strerror(reason)}")
