"""Landlock rules: the files, TCP ports and processes that this thread may still reach.

I/O. Source: https://docs.kernel.org/userspace-api/landlock.html; include/uapi/linux/landlock.h. A right that an older
kernel does not know is left out. Files that are already open stay usable.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import stat
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from gdp.ports.confine.system import call

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_VERSION: Final = 1
_PATH_BENEATH, _NET_PORT = 1, 2
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
_CHANGE_FOLDER: Final = 0x1FF0  # REMOVE_DIR to MAKE_SYM
_REFER, _TRUNCATE = 1 << 13, 1 << 14
_BIND_TCP, _CONNECT_TCP = 1 << 0, 1 << 1
_SCOPE_ABSTRACT_SOCKET, _SCOPE_SIGNAL = 1 << 0, 1 << 1


def abi() -> int:
    """Return the kernel's Landlock version; 0 if the kernel has no Landlock or it is off."""
    try:
        return call(_CREATE, None, 0, _VERSION)
    except OSError:
        return 0


def restrict(
    writes: Iterable[Path], reads: Iterable[Path] | None, tcp_ports: Iterable[int] | None, *, may_execute: bool
) -> int:
    """Restrict this thread and the threads that it starts; return the version used, 0 if there is no Landlock.

    The thread must have ``no_new_privs``, or CAP_SYS_ADMIN.

    Args:
        writes: files and folders to change, with everything below them; missing ones are skipped.
        reads: files and folders to read in addition; None: everything.
        tcp_ports: ports to listen on, and no TCP connection may be opened; None: any.
        may_execute: whether programs may be started.

    Raises:
        OSError: the system refuses.
    """
    version = abi()
    if not version:
        return 0
    changes = _WRITE_FILE | _CHANGE_FOLDER | (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    views = 0 if reads is None else _READ_FILE | _READ_DIR
    execution = 0 if may_execute else _EXECUTE
    net = _BIND_TCP | _CONNECT_TCP if version >= 4 and tcp_ports is not None else 0
    # A node that starts programs also ends them, and those share its domain. X11 and D-Bus use abstract sockets.
    scopes = (_SCOPE_SIGNAL | (0 if may_execute else _SCOPE_ABSTRACT_SOCKET)) if version >= 6 else 0
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    attributes = struct.pack("=QQQ", changes | views | execution, net, scopes)[:size]
    rules = call(_CREATE, ctypes.create_string_buffer(attributes, size), size, 0)
    try:
        for path in writes:
            _allow(rules, path, changes | views)
        for path in reads or ():
            _allow(rules, path, views)
        for port in tcp_ports or () if net else ():
            _add(rules, _NET_PORT, struct.pack("=QQ", _BIND_TCP, port))
        call(_RESTRICT, rules, 0)
    finally:
        os.close(rules)
    return version


def _allow(rules: int, path: Path, access: int) -> None:
    with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            if not stat.S_ISDIR(os.fstat(opened).st_mode):
                access &= _WRITE_FILE | _READ_FILE | _TRUNCATE
            if access:
                _add(rules, _PATH_BENEATH, struct.pack("=Qi", access, opened))
        finally:
            os.close(opened)


def _add(rules: int, kind: int, attributes: bytes) -> None:
    call(_ADD, rules, kind, ctypes.create_string_buffer(attributes, len(attributes)), 0)
