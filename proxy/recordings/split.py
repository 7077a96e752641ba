"""Recording in parts: the next file begins when one is large or old enough.

I/O, through ``writer``.
"""

from __future__ import annotations

import time
from pathlib import Path

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import Origin
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel, RosVersion


def first_part(path: Path, *, is_split: bool) -> Path:
    """Return the first file of a recording."""
    return _part(path, 0) if is_split else path


class SplitWriter:
    """A recording in progress: one file, or with a limit ``NAME_0.mcap``, ``NAME_1.mcap`` and so on.

    Args:
        path: of the only file.
        max_bytes: of messages in one file; None: no limit.
        max_s: seconds of one file; None: no limit.

    Attributes:
        paths: the files, in order.
        failure: why nothing is written any more; empty while it is.
        received: messages that were to be written.

    Raises:
        LocalError: a file exists, or cannot be created.
    """

    def __init__(
        self, path: Path, ros: RosVersion, *, max_bytes: int | None = None, max_s: float | None = None
    ) -> None:
        self.path = path
        self.ros = ros
        self.paths: list[Path] = []
        self.failure = ""
        self.received = 0
        self._is_split = max_bytes is not None or max_s is not None
        self._max_bytes = float("inf") if max_bytes is None else max_bytes
        self._max_s = float("inf") if max_s is None else max_s
        self._channels: list[Channel] = []
        self._numbers: dict[Channel, int] = {}
        self._written = 0  # messages in earlier parts
        self._writer = self._begin()

    @property
    def written(self) -> int:
        """Return the messages that can be read from the files, whatever happens now."""
        return self._written + self._writer.written

    def add(self, channel: Channel) -> int:
        """Return the handle of a channel, for all parts; errors as of ``BagWriter.add``."""
        if channel not in self._numbers:
            self._handles[len(self._channels)] = self._writer.add(channel)
            self._numbers[channel] = len(self._channels)
            self._channels.append(channel)
        return self._numbers[channel]

    def write(self, handle: int, stamp_ns: int, raw: bytes, origin: Origin | None = None) -> None:
        """Record one message. Raises ``LocalError``: as of ``BagWriter.write``, or the next part cannot be made."""
        self.received += 1
        if self.failure:
            raise LocalError(self.failure)
        try:
            is_large = self._bytes > 0 and self._bytes + len(raw) > self._max_bytes
            if is_large or (self._bytes and time.monotonic() > self._begun_s + self._max_s):
                self.close()
                self._writer, self._written = self._begin(), self.written
            if handle not in self._handles:
                self._handles[handle] = self._writer.add(self._channels[handle])
            self._writer.write(self._handles[handle], stamp_ns, raw, origin)
        except LocalError as error:
            self.failure = self._writer.failure or (str(error) if self._writer.is_closed else "")
            raise
        self._bytes += len(raw)

    def flush(self) -> None:
        """Write what is kept in memory; a failure becomes ``failure``."""
        self._writer.flush()
        self.failure = self.failure or self._writer.failure

    def close(self) -> None:
        """Complete the file; errors as of ``BagWriter.close``."""
        self._writer.close()

    def _begin(self) -> BagWriter:
        path = _part(self.path, len(self.paths)) if self._is_split else self.path
        writer = BagWriter(path, self.ros)
        self.paths.append(path)
        self._handles: dict[int, int] = {}
        self._bytes = 0
        self._begun_s = time.monotonic()
        return writer


def _part(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}_{number}{path.suffix}")
