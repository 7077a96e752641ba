"""Ownership of files and folders: the checks whether this process may act on their content.

I/O; it only reads.
This process's user and root are trusted. A command of root that sudo(8) started also trusts the user who called sudo,
because that user can become root. A folder with the sticky bit (``/tmp``) may be writable for others: only a file's
owner can replace or remove it there. A group with the number of its user belongs to that user alone (Debian's
USERGROUPS).
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from gdp.errors import LocalError

_ROOT: Final = 0
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO
_OTHERS_WRITE: Final = stat.S_IWGRP | stat.S_IWOTH


def refuse_foreign_file(path: Path, status: os.stat_result) -> None:
    """Refuse a private file that another user wrote, or that others can access.

    Args:
        status: of the open descriptor, so that the file cannot change in between.

    Raises:
        LocalError: it is not a regular file, belongs to an untrusted user, or group or others have any right to it.
    """
    if not stat.S_ISREG(status.st_mode):
        raise LocalError(f"{path}: a regular file is expected")
    if status.st_uid not in _trusted():
        raise LocalError(
            f"{path}: belongs to user {status.st_uid}, whom this process does not trust with a private file;"
            f" if it is yours, run: chown {os.geteuid()} {path}"
        )
    if status.st_mode & _OTHERS:
        mode = stat.S_IMODE(status.st_mode)
        raise LocalError(f"{path}: mode {mode:04o} lets others read a private file; run: chmod 600 {path}")


def refuse_shared_folder(folder: Path) -> None:
    """Refuse a folder in which another user could replace a private file.

    Raises:
        LocalError: the folder belongs to an untrusted user, or others may write to it.
        OSError: the folder does not exist.
    """
    status = folder.stat()
    if status.st_uid not in _trusted():
        raise LocalError(f"{folder}: belongs to user {status.st_uid}, who could replace the private files in it")
    if _writable_for_others(status) and not status.st_mode & stat.S_ISVTX:
        mode = stat.S_IMODE(status.st_mode)
        raise LocalError(
            f"{folder}: mode {mode:04o} lets others replace the private files in it; run: chmod go-w {folder}"
        )


def refuse_foreign_folder(folder: Path, why: str) -> None:
    """Refuse a folder that does not belong to this user alone.

    Args:
        why: purpose of the folder, as the end of a sentence.

    Raises:
        LocalError: it belongs to another user, or others may write to it.
        OSError: the folder does not exist.
    """
    status = folder.stat()
    if status.st_uid != os.geteuid() or status.st_mode & _OTHERS_WRITE:
        mode = stat.S_IMODE(status.st_mode)
        raise LocalError(
            f"{folder} must belong to this user alone, for {why}: it is user {status.st_uid}'s, mode {mode:04o}"
        )


def _writable_for_others(status: os.stat_result) -> bool:
    has_own_group = status.st_gid == status.st_uid
    return bool(status.st_mode & (stat.S_IWOTH if has_own_group else _OTHERS_WRITE))


def _trusted() -> frozenset[int]:
    user = os.geteuid()
    caller = os.environ.get("SUDO_UID", "")
    behind = {int(caller)} if user == _ROOT and caller.isascii() and caller.isdigit() else set()
    return frozenset({user, _ROOT} | behind)
