"""Audit log: a folder with the chained lines of an audit trail, bounded, and its verification.

I/O; times come in as arguments. ::

    audit.jsonl*                   the file in use
    audit-<sequence>.jsonl*        earlier files, by the sequence of their first line; the oldest are deleted

The chain continues from file to file. The next append drops a line without its end (a kill in the middle of a write).
Lines are written at once but not synced: a power failure may cost the last seconds.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from gdp.errors import LocalError
from gdp.stores.files import cut_unfinished_line, open_locked
from gdp.stores.ownership import refuse_shared_folder
from gdp.trust.audit import BEGIN, Action, AuditLine, AuditTrail

FILE_MAX_BYTES: Final = 4 << 20
FILES_MAX: Final = 8  # 32 MiB: more than a day at the highest rate of a flood
_CURRENT: Final = "audit.jsonl"
_OLDER: Final = "audit-*.jsonl"
_LINE_MAX_BYTES: Final = 4_096
_FOLDER_MODE: Final = 0o700


@dataclass(frozen=True, slots=True)
class Verified:
    """Result of a verification.

    Args:
        first: sequence of the first line; above 1: rotation deleted earlier ones.
        last_hash: of the last line; a copy kept elsewhere proves later that no line was cut off.
        events: number of events by action and kind, counts included.
    """

    lines: int
    first: int
    last_hash: str
    events: Counter[tuple[str, str]]


class AuditLog:
    """Audit log of one node or one authority.

    Raises:
        LocalError: the folder cannot be made, or does not belong to this user.
    """

    def __init__(self, folder: Path, *, file_max_bytes: int = FILE_MAX_BYTES, files_max: int = FILES_MAX) -> None:
        self._folder = folder
        self._file_max_bytes = file_max_bytes
        self._files_max = files_max
        try:
            folder.mkdir(mode=_FOLDER_MODE, parents=True, exist_ok=True)
            refuse_shared_folder(folder)
        except OSError as error:
            raise LocalError(f"{folder}: {error.strerror}") from error

    def write(self, trail: AuditTrail, mono_s: float, unix_s: float) -> None:
        """Append the pending lines of a trail.

        Raises:
            LocalError: the folder cannot be written; these lines are lost.
        """
        if not trail.is_due(mono_s):
            return
        path = self._folder / _CURRENT
        with open_locked(path, os.O_RDWR | os.O_CREAT) as file:
            seq, previous = self._end_of(path, file)
            lines = trail.poll_lines(mono_s, unix_s, seq, previous)
            file.write(b"".join(line.to_line() + b"\n" for line in lines))
            is_full = file.tell() >= self._file_max_bytes
            file.flush()
            if is_full:
                self._rotate(path, file)

    def _end_of(self, path: Path, file: BinaryIO) -> tuple[int, str]:
        """Return sequence and hash of the last whole line, and truncate the file after it."""
        line = cut_unfinished_line(path, file, _LINE_MAX_BYTES)
        if line is None:
            older = sorted(self._folder.glob(_OLDER))
            if not older:
                return 0, BEGIN
            path, line = older[-1], older[-1].read_bytes().splitlines(keepends=True)[-1]
        read = _read(f"{path}: last line", line)
        return read.seq, read.hash

    def _rotate(self, path: Path, file: BinaryIO) -> None:
        file.seek(0)
        first = AuditLine.from_line(file.readline())
        path.rename(self._folder / f"audit-{first.seq:012d}.jsonl")
        older = sorted(self._folder.glob(_OLDER))
        for each in older[: max(len(older) - (self._files_max - 1), 0)]:
            each.unlink()


def note_once(
    folder: Path, action: Action, what: str, *, who: str = "", about: str = "", reason: str = "", unix_s: float
) -> None:
    """Write one line, for a command that ends afterwards; arguments as in ``AuditLine``.

    Raises:
        LocalError: the folder cannot be written.
    """
    trail = AuditTrail()
    trail.begin()
    trail.record(action, what, who=who, about=about, reason=reason)
    AuditLog(folder).write(trail, time.monotonic(), unix_s)


def verify_audit(folder: Path) -> Verified:
    """Verify the chain of a folder's files, the oldest first.

    Raises:
        LocalError: a line is malformed, or does not follow from the line before; the text names file and line.
    """
    files = [*sorted(folder.glob(_OLDER)), *(each for each in [folder / _CURRENT] if each.exists())]
    events: Counter[tuple[str, str]] = Counter()
    count, first, seq, previous = 0, 0, 0, BEGIN
    for path in files:
        with open_locked(path, os.O_RDONLY) as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n") and path.name == _CURRENT:
                    break  # the next append drops it
                read = _read(f"{path}:{number}", line)
                if count == 0 and read.seq > 1:
                    seq, previous = read.seq - 1, read.previous  # older files were deleted by rotation
                if (read.seq, read.previous) != (seq + 1, previous):
                    raise LocalError(f"{path}:{number}: does not follow from the line before: the log was changed")
                count, first, seq, previous = count + 1, first or read.seq, read.seq, read.hash
                events[read.action, read.what] += read.count
    return Verified(count, first, previous, events)


def _read(where: str, line: bytes) -> AuditLine:
    try:
        return AuditLine.from_line(line)
    except LocalError as error:
        raise LocalError(f"{where}: {error}") from error
