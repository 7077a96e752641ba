"""What a reader tells its publisher: how far it is, and what it lacks.

Place: pure. Wire form, big-endian: ``flags (1) | next number (8) | next part (4) | ranges (2)`` and for each range
``number (8) | first part (4) | last part (4)``.
"""

from __future__ import annotations

import struct
from enum import IntFlag
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError
from gdp.limits import NACKS_PER_REPORT

__all__ = ["Missing", "Report", "ReportFlag"]

_HEAD: Final = struct.Struct("!BQIH")
_RANGE: Final = struct.Struct("!QII")


class ReportFlag(IntFlag):
    """What the reader is in the middle of."""

    NONE = 0
    NEW = 1  # it has not seen a status: tell it where to begin
    BYE = 2  # it leaves


class Missing(NamedTuple):
    """Parts ``first`` to ``last``, both included, of one message; ``last`` may lie beyond its end."""

    number: int
    first: int
    last: int


class Report(NamedTuple):
    """Everything before (next_number, next_part) is held; of what follows, ``missing`` is known to lack."""

    flags: ReportFlag
    next_number: int
    next_part: int
    missing: tuple[Missing, ...]

    def to_wire(self) -> bytes:
        """Return the wire form; ranges beyond ``NACKS_PER_REPORT`` wait for the next report."""
        ranges = self.missing[:NACKS_PER_REPORT]
        head = _HEAD.pack(self.flags, self.next_number, self.next_part, len(ranges))
        return head + b"".join(_RANGE.pack(*each) for each in ranges)

    @classmethod
    def from_wire(cls, wire: bytes) -> Report:
        """Read the wire form.

        Raises:
            FrameError: not exactly that.
        """
        if len(wire) < _HEAD.size:
            raise FrameError(DropReason.TRUNCATED, "report")
        flags, number, part, count = _HEAD.unpack_from(wire)
        if count > NACKS_PER_REPORT or len(wire) != _HEAD.size + count * _RANGE.size or flags > ReportFlag.BYE:
            raise FrameError(DropReason.MALFORMED, "report")
        ranges = tuple(Missing(*each) for each in _RANGE.iter_unpack(wire[_HEAD.size :]))
        return cls(ReportFlag(flags), number, part, ranges)
