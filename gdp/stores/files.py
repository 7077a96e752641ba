"""Files that hold keys: written whole or not at all, and private to their owner.

I/O.
A file appears under its name complete and synced, or not at all, so a kill in the middle leaves no partial file; its
name is synced, too. A private file has mode 0600 from its first byte on. It is read and written only where no other
user could have read or replaced it (``ownership``); a link in its place is not followed.
Each key folder has a ``.gitignore`` that covers all of it, also itself: Git reads one in every folder (gitignore(5)).
"""

from __future__ import annotations

import errno
import fcntl
import os
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from gdp.errors import LocalError
from gdp.stores.ownership import refuse_foreign_file, refuse_shared_folder

_IGNORE_FILE: Final = ".gitignore"
_IGNORE_TEXT: Final = "# private keys; git must not take any file of this folder\n*\n"
FILE_MAX_BYTES: Final = 1 << 20
_PRIVATE_MODE: Final = 0o600
_PUBLIC_MODE: Final = 0o644  # minus the umask
_DIRECTORY_MODE: Final = 0o700
_PIECE_BYTES: Final = 16 << 10


@dataclass(frozen=True, slots=True)
class NewFile:
    """Content of a new file, and who may read it."""

    data: bytes
    mode: int


def private(data: bytes) -> NewFile:
    """Return a file that only its owner may read."""
    return NewFile(data, _PRIVATE_MODE)


def public(data: bytes) -> NewFile:
    """Return a file that anyone may read."""
    return NewFile(data, _PUBLIC_MODE)


def write_all(directory: Path, files: Mapping[str, NewFile], *, force: bool = False) -> None:
    """Write files into a directory, which is made (mode 0700) if it is missing.

    Args:
        force: replace existing files; otherwise nothing is written if one of them exists.

    Raises:
        LocalError: a file exists already, one is private and others may write to the directory, or the system refuses.
    """
    try:
        is_new = not directory.exists()
        directory.mkdir(mode=_DIRECTORY_MODE, parents=True, exist_ok=True)
        if any(not new.mode & (stat.S_IRWXG | stat.S_IRWXO) for new in files.values()):
            refuse_shared_folder(directory)
        for name in files:
            if not force:
                refuse_existing(directory / name)
        for name, new in files.items():
            _write(directory / name, new, force=force)
        sync(directory)
        if is_new:
            sync(directory.parent)
    except OSError as error:
        raise _translated(error, directory) from error


def sync(path: Path) -> None:
    """Put a file, or the names in a folder, on the disk. Raises ``OSError``: the system refuses."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_public(path: Path) -> bytes:
    """Return the content of a file. Raises ``LocalError``: it is missing or too long, or the system refuses."""
    return _read(path)


def read_private(path: Path) -> bytes:
    """Return the content of a private file.

    Raises:
        LocalError: it is a link, belongs to another user than this one and root, group or others may access it or write
            to its directory, or as for ``read_public``.
    """
    return _read(path, is_private=True)


@contextmanager
def open_locked(path: Path, flags: int) -> Iterator[BinaryIO]:
    """Open a private file of lines: locked against other writers for reading, against all others for writing.

    Args:
        flags: as for ``os.open``; with ``os.O_RDWR`` the file is opened for writing.

    Raises:
        LocalError: it is another user's, others may access it, or the system refuses.
    """
    is_writer = bool(flags & os.O_RDWR)
    try:
        handle = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, _PRIVATE_MODE)
        with os.fdopen(handle, "r+b" if is_writer else "rb") as file:
            refuse_foreign_file(path, os.fstat(file.fileno()))
            fcntl.flock(file, fcntl.LOCK_EX if is_writer else fcntl.LOCK_SH)
            yield file
    except OSError as error:
        raise LocalError(f"{path}: {error.strerror}") from error


def cut_unfinished_line(path: Path, file: BinaryIO, line_max_bytes: int) -> bytes | None:
    """Truncate a file after its last whole line, and return that line with its end; None if the file is empty.

    Raises:
        LocalError: the last line is longer than ``line_max_bytes``.
    """
    end = file.seek(0, os.SEEK_END)
    begin = file.seek(max(end - 2 * line_max_bytes, 0))
    tail = file.read()
    whole = tail[: tail.rfind(b"\n") + 1]
    file.truncate(file.seek(begin + len(whole)))
    if not whole and begin:
        raise LocalError(f"{path}: its last line has no end; restore the file from a copy")
    return whole[whole.rfind(b"\n", 0, -1) + 1 :] or None


def read_at_most(file: BinaryIO, limit: int) -> bytes:
    """Return a file's bytes up to its end, or the first ``limit + 1`` bytes if it is longer.

    It reads in pieces, so a short file costs no buffer of the limit's length.
    """
    pieces = []
    left = limit + 1
    while left and (piece := file.read(min(left, _PIECE_BYTES))):
        pieces.append(piece)
        left -= len(piece)
    return b"".join(pieces)


def refuse_existing(path: Path) -> None:
    """Refuse to replace a file, or a link of its name. Raises ``LocalError``: it exists already."""
    if os.path.lexists(path):
        raise LocalError(f"{path}: is there already; --force replaces it")


def _write(path: Path, new: NewFile, *, force: bool) -> None:
    draft = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    handle = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, new.mode)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(new.data)
            file.flush()
            os.fsync(file.fileno())
        if force:
            os.replace(draft, path)
        else:
            os.link(draft, path)  # unlike a rename, a link never replaces a file
    except FileExistsError as error:
        raise LocalError(f"{path}: is there already; --force replaces it") from error
    finally:
        draft.unlink(missing_ok=True)


def _read(path: Path, *, is_private: bool = False) -> bytes:
    # O_NONBLOCK: a pipe in the file's place would block the open itself
    guards = os.O_NOFOLLOW | os.O_NONBLOCK if is_private else 0
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | guards)) as file:
            if is_private:
                refuse_foreign_file(path, os.fstat(file.fileno()))
                refuse_shared_folder(path.parent)
            data = read_at_most(file, FILE_MAX_BYTES)
    except OSError as error:
        if is_private and error.errno == errno.ELOOP:
            raise LocalError(f"{path}: is a link; name the private file itself") from error
        raise _translated(error, path) from error
    if len(data) > FILE_MAX_BYTES:
        raise LocalError(f"{path}: longer than {FILE_MAX_BYTES} bytes")
    return data


def _translated(error: OSError, path: Path) -> LocalError:
    return LocalError(f"{error.filename or path}: {error.strerror or error}")


def refuse_work_tree(directory: Path) -> None:
    """Refuse the root of a work tree as a key folder. Raises ``LocalError``: all in it would have to be ignored."""
    if (directory / ".git").exists():
        raise LocalError(
            f"{directory} is the root of a git work tree; keep keys in a folder of their own, such as"
            f" {directory / 'keys'}"
        )


def ignore_folder(directory: Path) -> None:
    """Let git ignore a folder of keys, also if it is moved into a work tree later; an existing file stays.

    Raises:
        LocalError: the system refuses.
    """
    if not (directory / _IGNORE_FILE).exists() and not _is_ours(directory.parent / _IGNORE_FILE):
        write_all(directory, {_IGNORE_FILE: public(_IGNORE_TEXT.encode())})


def _is_ours(path: Path) -> bool:
    return path.is_file() and path.read_text(encoding="utf-8", errors="replace") == _IGNORE_TEXT


def work_tree_of(path: Path) -> Path | None:
    """Return the git work tree in which a path lies, without asking git; None: it lies in none."""
    return next((each for each in path.absolute().parents if (each / ".git").exists()), None)
