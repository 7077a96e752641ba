"""Windows around marks: which records of a capsule go to its holder if only what stands around an event is kept.

Sans-I/O; times are Unix nanoseconds. A window begins with the last checkpoint at or before ``before`` a mark, and ends
with a checkpoint that is signed when ``after`` it has passed. Windows that touch are one. The body of a mark begins
with a statement that anyone can read::

    number of the window's first record, 0: nothing is left out (8) | from (8) | to (8) | number of the mark before (8)

The mark's name and time follow, sealed as a message is.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.capsule.record import Record
from gdp.errors import DropReason, RemoteError

_STATEMENT: Final = struct.Struct("!QQQQ")


class Mark(NamedTuple):
    """What a mark states in the clear.

    Attributes:
        first: number of the first record of its window; 0: nothing is left out of the capsule.
        from_ns: begin of its window; ``to_ns``: end.
        previous: number of the record of the mark before; 0: none.
    """

    first: int
    from_ns: int
    to_ns: int
    previous: int

    def to_bytes(self) -> bytes:
        """Return the statement."""
        return _STATEMENT.pack(*self)

    @classmethod
    def from_record(cls, record: Record) -> Mark:
        """Read it from the record of a mark. Raises ``RemoteError``: MALFORMED."""
        statement = next(iter(record.frames), b"")
        if len(statement) != _STATEMENT.size:
            raise RemoteError(DropReason.MALFORMED, "mark")
        return cls(*_STATEMENT.unpack(statement))


class Place(NamedTuple):
    """A checkpoint: where its record begins, and its number and time."""

    offset: int
    number: int
    time_ns: int


@dataclass
class _Window:
    begin: int
    to_ns: int
    end: int | None = None  # None: it has not ended


class Windows:
    """Windows of one capsule at its writer; ``before_ns`` and ``after_ns`` are of each mark."""

    def __init__(self, before_ns: int, after_ns: int) -> None:
        self._before_ns, self._after_ns = before_ns, after_ns
        self._places = deque[Place]()  # as far back as a window may begin
        self._windows: list[_Window] = []

    def add_checkpoint(self, place: Place) -> None:
        """Note a checkpoint that was appended."""
        self._places.append(place)
        while len(self._places) > 1 and self._places[1].time_ns <= place.time_ns - self._before_ns:
            self._places.popleft()

    def mark(self, time_ns: int) -> Mark:
        """Open a window around a time, and return what its mark states, without the mark before."""
        from_ns, to_ns = max(time_ns - self._before_ns, 0), time_ns + self._after_ns
        place = self._places[0] if self._places else Place(0, 0, 0)
        for each in self._places:
            if each.time_ns <= from_ns:
                place = each
        self.open(place.offset, to_ns)
        return Mark(place.number, from_ns, to_ns, 0)

    def open(self, begin: int, to_ns: int) -> None:
        """Open a window from an offset until a time, or extend the one that touches it."""
        last = self._windows[-1] if self._windows else None
        if last is not None and (last.end is None or begin <= last.end):
            last.end, last.to_ns = None, max(last.to_ns, to_ns)
        else:
            self._windows.append(_Window(begin, to_ns))

    def is_due(self, time_ns: int) -> bool:
        """Return whether the last window is to be closed, behind a checkpoint."""
        return bool(self._windows) and self._windows[-1].end is None and time_ns >= self._windows[-1].to_ns

    def close(self, end: int) -> None:
        """Close the last window at an offset."""
        self._windows[-1].end = end

    def next(self, head: int, end: int) -> tuple[int, int] | None:
        """Return from where to where the next records stand for a holder that has ``head``; None: there are none.

        Args:
            end: behind the last record here.
        """
        for each in self._windows:
            begin, stop = max(each.begin, head), end if each.end is None else min(each.end, end)
            if begin < stop:
                return begin, stop
        return None

    def drop(self, confirmed: int) -> int:
        """Drop what a holder has confirmed; return the offset below which no record is needed here."""
        while len(self._windows) > 1 and self._windows[0].end is not None and self._windows[0].end <= confirmed:
            del self._windows[0]
        needed = [max(each.begin, confirmed) for each in self._windows if each.end is None or each.end > confirmed]
        return min([self._places[0].offset, *needed]) if self._places else 0
