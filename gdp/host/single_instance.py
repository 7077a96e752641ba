"""Locks of a running node: one process for each identity on a host, one for each device of a network namespace.

I/O. Source: fcntl_locking(2). A lock is a POSIX record lock on a file of the lock directory. The kernel releases it
when its process ends in any way, and ``F_GETLK`` reports the process that holds it. The directory is host-wide, so it
also shows the same identity in another network namespace or another folder::

    root                    /run/gdp-locks
    any other user          $XDG_RUNTIME_DIR/gdp-locks, or /tmp/gdp-locks-UID; it also checks the locks of root

    <64 hex digits>.lock                     an identity
    device-<inode of the namespace>-<name>.lock

A record lock belongs to the process: a second request from the same process is granted.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import shlex
import struct
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.names import Name

log = logging.getLogger(__name__)

_ROOT_DIRECTORY: Final = Path("/run/gdp-locks")
_NAMESPACE: Final = Path("/proc/thread-self/ns/net")
_FLOCK: Final = struct.Struct("@hhqqi")  # struct flock: type, whence, start, length, pid
_PYTHON: Final = "python"
_COMMAND_MAX: Final = 200


@contextlib.contextmanager
def run_alone(role: str, name: Name) -> Iterator[None]:
    """Hold the identity ``name`` until the context ends.

    Args:
        role: word for the node in the error, such as ``switch``.

    Raises:
        LocalError: another process of this host runs with this identity; the text names it.
    """
    with _lock(f"{name.to_text()}.lock", f"this {role} already runs, {{holder}}; stop it first"):
        yield


@contextlib.contextmanager
def own_devices(ifnames: Iterable[str]) -> Iterator[None]:
    """Hold devices of this network namespace until the context ends, whether they already exist or not.

    Raises:
        LocalError: another node uses one of them; the text names it.
    """
    namespace = _NAMESPACE.stat().st_ino
    with contextlib.ExitStack() as stack:
        for ifname in dict.fromkeys(ifnames):
            refusal = f"{ifname} is in use by another node, {{holder}}; stop it first, or name another device"
            stack.enter_context(_lock(f"device-{namespace}-{ifname}.lock", refusal))
        yield


@contextlib.contextmanager
def _lock(file: str, refusal: str) -> Iterator[None]:
    directory = _directory()
    if directory is None:
        yield
        return
    if directory != _ROOT_DIRECTORY:
        _refuse_if_held(_ROOT_DIRECTORY / file, refusal)
    path = directory / file
    descriptor = _locked(path, refusal)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(path: Path, refusal: str) -> int:
    """Return an open descriptor of ``path`` that holds the lock."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = _holder(descriptor)
            os.close(descriptor)
            if holder is None:  # the holder released it in the meantime
                continue
            raise LocalError(refusal.format(holder=holder)) from error
        if _is_linked(descriptor, path):
            return descriptor
        os.close(descriptor)  # its last holder deleted the file when it ended


def _is_linked(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _refuse_if_held(path: Path, refusal: str) -> None:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return  # no such lock, or no right to read it
    try:
        holder = _holder(descriptor)
    finally:
        os.close(descriptor)
    if holder is not None:
        raise LocalError(refusal.format(holder=holder))


def _holder(descriptor: int) -> str | None:
    """Return the holder of the lock, in words; None if the lock is free."""
    asked = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
    kind, _, _, _, pid = _FLOCK.unpack(fcntl.fcntl(descriptor, fcntl.F_GETLK, asked))
    if kind == fcntl.F_UNLCK:
        return None
    if pid <= 0:
        return "in another container of this host"
    command = _command(pid)
    return f"pid {pid} ({command})" if command else f"pid {pid}"


def _command(pid: int) -> str:
    """Return a process's command line as typed; empty if this user may not read it."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace").rstrip("\0").split("\0")
    except OSError:
        return ""
    if len(words) > 1 and Path(words[0]).name.startswith(_PYTHON) and not words[1].startswith("-"):
        words = [Path(words[1]).name, *words[2:]]
    text = shlex.join(words)
    return text if len(text) <= _COMMAND_MAX else f"{text[:_COMMAND_MAX]}..."


def lock_directories() -> tuple[Path, ...]:
    """Return the directories of locks that concern this user: its own, then that of root."""
    return tuple(dict.fromkeys((lock_directory(), _ROOT_DIRECTORY)))


def _directory() -> Path | None:
    """Return the lock directory, made if necessary; None, with a warning, if it cannot exist."""
    path = lock_directory()
    try:
        path.mkdir(mode=0o755, exist_ok=True)
        status = path.lstat()
        if status.st_uid != os.geteuid() or status.st_mode & 0o022:
            raise PermissionError(f"{path} must belong to this user, and others must not write to it")
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(f"{path} is read-only")
    except OSError as error:
        log.warning("no lock held: a second process with this identity or device goes unnoticed reason=%s", error)
        return None
    return path


def lock_directory() -> Path:
    """Return the directory of this user's locks, whether it exists or not."""
    if os.geteuid() == 0 and os.access(_ROOT_DIRECTORY.parent, os.W_OK):
        return _ROOT_DIRECTORY
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    if runtime and os.access(runtime, os.W_OK | os.X_OK):
        return Path(runtime) / "gdp-locks"
    return Path(tempfile.gettempdir()) / f"gdp-locks-{_user()}"


def _user() -> int:
    """Return the user id outside any user namespace, the same in all of them; user_namespaces(7)."""
    inside, outside, _ = map(int, Path("/proc/self/uid_map").read_text(encoding="ascii").split()[:3])
    return os.geteuid() - inside + outside
