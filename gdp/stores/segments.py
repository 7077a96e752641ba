"""Segment files of one capsule: bytes by offset, of which the oldest files may be dropped.

I/O. Each file is named by the offset of its first byte, in hex, and begins with a checkpoint. What ``append`` has
returned from is on the disk (fdatasync; a new file's name too). A write that fails leaves no byte behind. A file may
be elsewhere: it is fetched when it is read. One thread writes, and others may read meanwhile.
"""

from __future__ import annotations

import errno
import os
import threading
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path
from typing import Final

from gdp.closing import ClosedOnExit
from gdp.errors import StoreError
from gdp.stores.files import private, sync, write_all

SEGMENT_BYTES: Final = 64 << 20  # after which the next checkpoint begins a file
SUFFIX: Final = ".records"


class Segments(ClosedOnExit):
    """The files of one capsule.

    Args:
        folder: is made if it is missing.
        spare_bytes: free space of the disk below which nothing is appended.

    Attributes:
        absent: offsets of the files that are elsewhere.
        held_bytes: of all files; ``here_bytes``: of those that are here.
        changed: offsets of the files whose size changed, or that were dropped; whom that concerns removes them.
        fetch: returns such a file, whole.

    Raises:
        StoreError: the system refuses; every method may raise this.
    """

    def __init__(self, folder: Path, spare_bytes: int = 0) -> None:
        self.folder = folder
        self._spare_bytes = spare_bytes
        self._sizes: dict[int, int] = {}  # by offset, rising
        self._last: int | None = None  # descriptor of the last file
        self._counting = threading.Lock()  # who reads may fetch
        self.absent, self.changed = set[int](), set[int]()
        self.held_bytes = self.here_bytes = 0
        self.fetch: Callable[[int], bytes] | None = None
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            for path in sorted(folder.glob("*" + SUFFIX)):
                if size := path.stat().st_size:  # an empty one was begun before a crash
                    self._set(int(path.stem, 16), size)
        except (OSError, ValueError) as error:
            raise StoreError(f"{folder}: {error}") from error

    @property
    def begin(self) -> int:
        """Return the offset of the first byte."""
        return next(iter(self._sizes), 0)

    @property
    def end(self) -> int:
        """Return the offset behind the last byte."""
        return self.last + self._sizes.get(self.last, 0)

    @property
    def last(self) -> int:
        """Return the offset at which the last file begins."""
        return next(reversed(self._sizes), 0)

    @property
    def offsets(self) -> list[int]:
        """Return where each file begins."""
        return list(self._sizes)

    def size_of(self, offset: int) -> int:
        """Return the bytes of the file that begins at an offset; 0: there is none."""
        return self._sizes.get(offset, 0)

    def append(self, data: bytes, *, at: int | None = None) -> None:
        """Append bytes, and put them on the disk.

        Args:
            at: begin a file at this offset, which is not below the end; None: continue the last one.

        Raises:
            StoreError: the disk is full, or the system refuses.
        """
        try:
            free = os.statvfs(self.folder)
            if free.f_bavail * free.f_frsize < self._spare_bytes + len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if at is not None or not self._sizes:
                self._begin_file(at or 0)
            handle, size = self._handle(), self._sizes[self.last]
            try:
                written = 0
                while written < len(data):
                    written += os.pwrite(handle, data[written:], size + written)
                os.fdatasync(handle)
            except OSError:
                os.ftruncate(handle, size)
                raise
            self._set(self.last, size + len(data))
        except OSError as error:
            raise StoreError(f"{self.folder}: {error.strerror}") from error

    def read(self, offset: int, most: int) -> tuple[int, bytes]:
        """Return up to ``most`` bytes of one file, with their offset: as asked, or behind the gap that is there."""
        begins = list(self._sizes)
        index = max(bisect_right(begins, offset) - 1, 0)
        if not begins:
            return offset, b""
        if offset >= begins[index] + self.size_of(begins[index]) and index + 1 < len(begins):
            index += 1
        begin = begins[index]
        offset = max(offset, begin)
        most = max(min(most, begin + self.size_of(begin) - offset), 0)  # what is behind is not on the disk yet
        try:
            if begin not in self.absent:
                with self._path(begin).open("rb") as file:
                    file.seek(offset - begin)
                    return offset, file.read(most)
        except OSError as error:
            if begin not in self.absent:  # else it was evicted meanwhile
                raise StoreError(f"{self.folder}: {error.strerror}") from error
        if self.fetch is None:
            raise StoreError(f"{self._path(begin)}: is in a bucket, which is not open")
        return offset, self.fetch(begin)[offset - begin :][:most]

    def has(self, offset: int, data: bytes) -> bool:
        """Return whether what is here from an offset on is the same, as far as something is here."""
        end = offset + len(data)
        at = offset
        while at < end:
            begin, known = self.read(at, end - at)
            if not known or begin >= end:
                return True
            if data[begin - offset :][: len(known)] != known[: end - begin]:
                return False
            at = begin + len(known)
        return True

    def replace(self, offset: int, data: bytes) -> None:
        """Replace or add the file that begins at an offset, whole or not at all.

        Raises:
            LocalError: the system refuses.
        """
        self.close()
        write_all(self.folder, {self._path(offset).name: private(data)}, force=True)
        self._set(offset, len(data))

    def set_absent(self, offset: int, size: int) -> None:
        """Note that the file which begins at an offset is elsewhere, and has so many bytes; 0: it is nowhere."""
        self.close()
        self._set(offset, size, is_absent=True)
        if not size:
            self.drop(offset)

    def keep_fetched(self, offset: int, data: bytes) -> None:
        """Have an absent file here again. Raises ``LocalError``: the system refuses."""
        write_all(self.folder, {self._path(offset).name: private(data)}, force=True)
        if not self._set(offset, None):  # it was dropped meanwhile
            self._path(offset).unlink(missing_ok=True)

    def evict(self, offset: int) -> None:
        """Remove a file that is elsewhere, too."""
        if offset == self.last:
            self.close()
        self._set(offset, None, is_absent=True)
        self._path(offset).unlink(missing_ok=True)

    def age_of(self, offset: int) -> float:
        """Return when the file that begins at an offset was written or fetched last, Unix seconds; 0: it is gone."""
        try:
            return self._path(offset).stat().st_mtime
        except OSError:
            return 0.0

    def cut(self, end: int) -> None:
        """Drop what lies behind an offset within the last file."""
        try:
            os.ftruncate(self._handle(), end - self.last)
        except OSError as error:
            raise StoreError(f"{self.folder}: {error.strerror}") from error
        self._set(self.last, end - self.last)

    def drop(self, offset: int) -> None:
        """Remove the file that begins at an offset; a power cut does not bring it back."""
        if offset == self.last:
            self.close()
        self._path(offset).unlink(missing_ok=True)
        sync(self.folder)
        self._set(offset, 0)
        del self._sizes[offset]

    def close(self) -> None:
        """Close the last file."""
        if self._last is not None:
            os.close(self._last)
            self._last = None

    def _set(self, offset: int, size: int | None, *, is_absent: bool = False) -> bool:
        """Note the size of a file, None: as before, and whether it is elsewhere; return whether it is known."""
        with self._counting:
            before, here = self._sizes.get(offset), 0 if offset in self.absent else self._sizes.get(offset, 0)
            size = before if size is None else size
            (self.absent.add if is_absent and size is not None else self.absent.discard)(offset)
            if size is None:
                return False
            self.held_bytes += size - (before or 0)
            self.here_bytes += (0 if is_absent else size) - here
            if size != before:
                self.changed.add(offset)
                is_between = before is None and offset < self.last
                self._sizes[offset] = size
                self._sizes = dict(sorted(self._sizes.items())) if is_between else self._sizes
            return True

    def _begin_file(self, offset: int) -> None:
        self.close()
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        self._last = os.open(self._path(offset), flags, 0o600)
        self._set(offset, 0)
        os.fsync(self._last)  # empty before its name is there: without a journal, the name may lead to a dropped file
        sync(self.folder)

    def _handle(self) -> int:
        if self._last is None:
            if self.last in self.absent:
                self.read(self.last, 1)
            self._last = os.open(self._path(self.last), os.O_RDWR | os.O_CLOEXEC)
        return self._last

    def _path(self, offset: int) -> Path:
        return self.folder / f"{offset:016x}{SUFFIX}"
