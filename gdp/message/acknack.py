"""AckNack: a reader's report of the messages it has and the ones it lacks.

Sans-I/O. Source: RTPS 2.5, section 8.3.8.1. Wire form, big-endian::

    flags (1) | share (1) | next number (8) | next part (4) | next sequence number (8) | lost (8) | received (4)
    | newest number (8) | newest part (4) | held (4) | frames (4) | receipts (8) | ranges (2)
    for each range: number (8) | first part (4) | last part (4)
"""

from __future__ import annotations

import struct
from enum import IntFlag
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError
from gdp.limits import NACKS_PER_REPORT
from gdp.sansio import new_tuple

_HEAD: Final = struct.Struct("!BBQIQQIQIIIQH")
_HEAD_BYTES: Final = _HEAD.size
_U32_MAX: Final = (1 << 32) - 1
_U64_MAX: Final = (1 << 64) - 1
FRAMES_MASK: Final = (1 << 32) - 1
_RANGE: Final = struct.Struct("!QII")


class AckNackFlag(IntFlag):
    """State of the reader."""

    NONE = 0
    NEW = 1  # it has not seen a Heartbeat: it requests its start
    BYE = 2  # it leaves
    PACED = 4  # it has stated its pace to its switch


_FLAGS: Final = {int(flag): flag for flag in AckNackFlag} | {0: AckNackFlag.NONE}  # to construct one takes longer


class MissingRange(NamedTuple):
    """Fragments ``first`` to ``last``, both included, of one message; ``last`` may lie beyond its end."""

    number: int
    first: int
    last: int


class AckNack(NamedTuple):
    """Everything before (next_number, next_part) is held; of what follows, ``missing`` is known to be missing.

    Messages with sequence numbers before ``sequence`` were delivered, except ``lost`` of them. A report flagged NEW
    names what its reader had of this incarnation of the publisher before, and zeros if nothing. ``share`` is how much
    of striped messages the second path is to carry, in 255ths; in a report flagged PACED it is the reader's pace.

    ``received`` counts the verified DATA frames of this incarnation, modulo 2^32; the newest of them was (newest,
    newest_part), which came ``held_us`` microseconds before this report left. The writer measures the path by them. In
    a report flagged NEW, ``held_us`` is for how long its reader has waited for a publisher.

    ``frames`` counts the frames of messages that came, copies included, modulo 2**32. ``receipts`` is the sum of the
    samples among the frames that ``received`` counts.
    """

    flags: AckNackFlag
    next_number: int
    next_part: int
    missing: tuple[MissingRange, ...]
    sequence: int = 0
    lost: int = 0
    share: int = 0
    received: int = 0
    newest: int = 0
    newest_part: int = 0
    held_us: int = 0
    frames: int = 0
    receipts: int = 0

    def to_wire(self) -> bytes:
        """Return the wire form; ranges beyond ``NACKS_PER_REPORT`` wait for the next report."""
        flags, number, part, missing, sequence, lost, share, received, *newest, held_us, frames, receipts = self
        ranges = [_RANGE.pack(*each) for each in missing[:NACKS_PER_REPORT]] if missing else []
        sequence = sequence if sequence < _U64_MAX else _U64_MAX
        lost = lost if lost < _U64_MAX else _U64_MAX
        held_us = held_us if held_us < _U32_MAX else _U32_MAX
        counts = sequence, lost, received & _U32_MAX, *newest, held_us, frames, receipts
        return b"".join([_HEAD.pack(flags, share, number, part, *counts, len(ranges)), *ranges])

    @classmethod
    def from_wire(cls, wire: bytes) -> AckNack:
        """Read the wire form. Raises ``FrameError``: the bytes are not exactly one AckNack."""
        size = len(wire)
        if size < _HEAD_BYTES:
            raise FrameError(DropReason.TRUNCATED, "report")
        flags, share, number, part, sequence, lost, *path, count = _HEAD.unpack_from(wire)
        if count > NACKS_PER_REPORT or size != _HEAD_BYTES + count * _RANGE.size or flags not in _FLAGS:
            raise FrameError(DropReason.MALFORMED, "report")
        ranges: tuple[MissingRange, ...] = ()
        if count:
            ranges = tuple(MissingRange(*each) for each in _RANGE.iter_unpack(wire[_HEAD_BYTES:]))
        return new_tuple(cls, (_FLAGS[flags], number, part, ranges, sequence, lost, share, *path))
