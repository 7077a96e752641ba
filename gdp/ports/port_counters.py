"""Counters of the devices of this network namespace. I/O.

Source: proc_pid_net(5), ``/proc/pid/net/dev``. The file is opened at once and read again at each call, so that a node
that has given its rights away still reads it, and reads its own namespace.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

_FILE: Final = Path("/proc/self/net/dev")
_READ_BYTES: Final = 1 << 18  # about 2,000 devices
_COLUMNS: Final = (1, 9, 0, 8, 2, 10, 3, 11)  # of packets, bytes, errors and drops, each received and sent


class PortCounters:
    """Counters of the devices; without ``/proc`` there are none."""

    def __init__(self) -> None:
        try:
            self._file = os.open(_FILE, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:  # a container without it: a view then shows no rates of links
            self._file = -1

    def read(self) -> dict[str, tuple[int, ...]]:
        """Return eight counts by device since it exists: frames, bytes, errors and drops, each in and out.

        All protocols count together. Drops of received frames include those that the device itself had no space for.
        Any thread may call it.
        """
        if self._file < 0:
            return {}
        text = os.pread(self._file, _READ_BYTES, 0).decode("ascii", "replace")
        found = {}
        for line in text.splitlines()[2:]:
            device, _, columns = line.partition(":")
            numbers = columns.split()
            if len(numbers) > max(_COLUMNS):
                found[device.strip()] = tuple(int(numbers[column]) for column in _COLUMNS)
        return found

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
