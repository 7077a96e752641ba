"""Output of commands: text of others, escaped where it goes to a terminal, which obeys control characters.

I/O. Files and pipes get the text as it is. A command waits for the reader of its output; a node never does.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import logging
import os
import select
import sys
from typing import TYPE_CHECKING, Final, TextIO

from gdp.intervals import LINGER_S
from gdp.printable import escaped

if TYPE_CHECKING:
    from typing_extensions import Buffer

log = logging.getLogger(__name__)

_BACKLOG_BYTES: Final = 1 << 16  # as much as a pipe of Linux holds


def echo(text: str = "", *, err: bool = False) -> None:
    """Print text and a line feed, and flush it; ``err``: to standard error."""
    stream = sys.stderr if err else sys.stdout
    shown = escaped(text) if stream.isatty() else text
    stream.write(shown.encode("utf-8", "backslashreplace").decode() + "\n")
    stream.flush()


def for_stdout(text: str) -> str:
    """Return text as standard output may have it."""
    return escaped(text) if sys.stdout.isatty() else text


def unblocked(stream: TextIO) -> TextIO:
    """Return a stream to the same file that does not block; one without a descriptor is returned as it is.

    A line that finds more than ``_BACKLOG_BYTES`` unwritten is dropped. The log has the count once there is space. At
    its end the process waits ``LINGER_S`` for a reader to take what is left.
    """
    try:
        backlog = _Backlog(stream.fileno(), stream.name)
    except io.UnsupportedOperation:
        return stream
    atexit.register(backlog.finish)
    return io.TextIOWrapper(backlog, encoding="utf-8", errors="backslashreplace", write_through=True)


class _Backlog(io.BufferedIOBase):
    """What a pipe, a socket or a terminal has no space for yet, each ``write`` being whole lines.

    The flags of the descriptor stay as they are, because other processes may have the same file. Where poll(2) reports
    space, Linux takes ``PIPE_BUF`` bytes without blocking.
    """

    def __init__(self, descriptor: int, name: str) -> None:
        self._descriptor, self.name = descriptor, name
        self._waiting = bytearray()
        self._dropped = 0
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLOUT)

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return os.isatty(self._descriptor)

    def writable(self) -> bool:
        """Return that it can be written."""
        return True

    def write(self, data: Buffer, /) -> int:
        """Write lines, now or later, or drop them. Raises ``BrokenPipeError``: no process can read them any more."""
        self.drain()
        if len(self._waiting) > _BACKLOG_BYTES:
            self._dropped += 1
        else:
            if dropped := self._dropped:
                self._dropped = 0
                log.warning("output was not read, so lines of it were dropped: stream=%s lines=%d", self.name, dropped)
            self._waiting += data
            self.drain()
        return memoryview(data).nbytes

    def drain(self, patience_s: float = 0.0) -> None:
        """Write what there is space for; end when there was none for ``patience_s``."""
        while self._waiting and self._poll.poll(patience_s * 1e3):
            del self._waiting[: os.write(self._descriptor, self._waiting[: select.PIPE_BUF])]

    def finish(self) -> None:
        """Write what is left while its reader takes it."""
        with contextlib.suppress(OSError):
            self.drain(LINGER_S)
