"""Reader of an untrusted recording: a process without rights decodes it, within limits.

I/O, through that process. Its output is checked like the recording: a decoder under an attacker's control can send
wrong messages, as the recording could, and no more. The pipe bounds how far it works ahead.
Errors: a recording that cannot be read raises ``ConfigError`` with the file and the reason; a decoder that ends early,
or falls silent, raises ``RecordingError``.
"""

from __future__ import annotations

import contextlib
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from gdp.closing import ClosedOnExit
from gdp.errors import ConfigError, LocalError, RemoteError
from gdp.printable import printable
from proxy.recordings.limits import BagLimits
from proxy.recordings.process import BagProcess, Cost, RecordingError, StoppedError
from proxy.recordings.source import ZSTD, Message
from proxy.recordings.stream import FailedError, FrameReader, RefusedError
from proxy.recordings.unpacking import file_max_bytes
from proxy.serial.channel import Channel

_SQLITE: Final = b"SQLite format 3\0"
_Waiting = Callable[[], bool]


class BagReader(ClosedOnExit):
    """An open recording.

    Args:
        path: a ``.bag``, ``.mcap`` or ``.db3`` file, or a rosbag2 folder.

    Attributes:
        count: messages that ``messages`` will yield, as far as known in advance.
        counts: messages of each channel; None where the recording has no index with them.
        unread: why some messages could not be read, and about how many; empty where all could. Final after
            ``messages``.
        missing: messages that were announced and not given. Final after ``messages``.

    Raises:
        ConfigError: it cannot be read.
        RecordingError: its decoder failed.
    """

    def __init__(self, path: Path | str, limits: BagLimits | None = None) -> None:
        self.path = Path(path)
        self.unread = ""
        self.missing = 0
        self._frames = FrameReader()
        self._is_stopped = False
        with contextlib.ExitStack() as stack:
            try:
                size = _bytes_of(self.path)
                scratch = _scratch(self.path, stack)
            except OSError as error:
                raise ConfigError(str(self.path), "", f"cannot be read: {error.strerror}") from error
            self._process = BagProcess(self.path, _cost(limits or BagLimits(), size), scratch)
            stack.callback(self._process.close)
            with self._checked():
                self.count, self.counts = self._frames.open(self._process.read)
            self._stack = stack.pop_all()

    @property
    def channels(self) -> list[Channel]:
        """Return every topic of every publisher, in the recording's order."""
        return self._frames.channels

    def messages(self, waiting: _Waiting | None = None) -> Iterator[Message]:
        """Yield (channel index, stamp in ns, bytes) in time order; a file that ends early is no error.

        One iterator at a time: the next one consumes the rest of an earlier one.

        Args:
            waiting: called some times a second while the decoder works; returns whether to continue. After False, the
                recording yields nothing more.

        Raises:
            ConfigError, RecordingError: the decoder failed.
        """
        if self._is_stopped:
            return

        def take(size: int) -> bytes:
            return self._process.read(size, waiting)

        try:
            with self._checked():
                self._frames.skip(take)
                self._process.request_messages()
                unread, given = (yield from self._frames.messages(take)), self._frames.given
                self.missing = max(0, self.count - given)
                lacking = f"{given} of {self.count} announced messages are given" if self.missing else ""
                self.unread = printable("; ".join(filter(None, (unread, lacking))))
        except StoppedError:
            self._is_stopped = True

    def close(self) -> None:
        """End the decoder."""
        self._stack.close()

    @contextlib.contextmanager
    def _checked(self) -> Iterator[None]:
        """Translate the decoder's end, and invalid output, into errors that name the recording."""
        try:
            yield
        except RefusedError as error:
            raise ConfigError(str(self.path), "", printable(str(error))) from error
        except FailedError as error:
            why = printable(str(error))
            if not why:
                raise self._process.lacks("memory") from error
            raise RecordingError(self.path, f"its decoder failed: {why}") from error
        except RecordingError:
            raise
        except (LocalError, RemoteError) as error:
            raise RecordingError(self.path, f"its decoder said what makes no sense: {error}") from error


def _cost(limits: BagLimits, size: int) -> Cost:
    return Cost(limits.memory_for(size), limits.cpu_s_for(size), limits.wait_s_for(size), file_max_bytes(size))


def _bytes_of(path: Path) -> int:
    """Return the length of a recording's files."""
    found = path.stat()
    if stat.S_ISDIR(found.st_mode):
        return sum(entry.stat().st_size for entry in path.iterdir() if entry.is_file())
    if not stat.S_ISREG(found.st_mode):
        raise ConfigError(str(path), "", "cannot be read: neither a file nor a folder")
    return found.st_size


def _scratch(path: Path, stack: contextlib.ExitStack) -> Path | None:
    """Return a folder for copies of databases and of compressed files, where the decoder may need one."""
    if not path.is_dir():
        with path.open("rb") as file:
            if not file.read(len(_SQLITE)).startswith((_SQLITE, ZSTD)):
                return None
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gdp-recording-")))
