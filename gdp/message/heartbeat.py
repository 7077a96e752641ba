"""Heartbeat: a writer's report of its first and last available message, new readers' starts, and the description.

Sans-I/O. Source: RTPS 2.5, section 8.3.8.6. It is sent as a sealed and signed message. Wire form, big-endian::

    oldest (8) | its sequence number (8) | sent number (8) | sent part (4) | its sequence number (8)
    | starts (2) | moves (1) | gone (1)
    for each start: reader (32) | its incarnation (8) | number (8) | sequence number (8) | confirmed (8)
    for each move: first (8) | span (8) | to (8)
    for each range that is gone: first (8) | last (8) | reason (1)
    if the highest bit of ``gone`` is set: paces (1), and for each: reader (32) | pace (1)
    description, empty when this Heartbeat brings none
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError
from gdp.limits import NUMBER_MAX
from gdp.message.loss import GONE_MAX, LossReason, LostRange
from gdp.message.renumbering import MOVES_MAX, Renumbering

STARTS_MAX: Final = 64  # readers whose start one Heartbeat carries; more get the next one
PACES_MAX: Final = 32
_HEAD: Final = struct.Struct("!QQQIQHBB")
_START: Final = struct.Struct("!32sQQQQ")
_MOVE: Final = struct.Struct("!QQQ")
_GONE: Final = struct.Struct("!QQB")
_PACE: Final = struct.Struct("!32sB")
_HAS_PACES: Final = 0x80  # of the count of ranges that are gone

_REASONS: Final = frozenset(LossReason)


class StreamStart(NamedTuple):
    """Where a new reader begins.

    Args:
        incarnation: of the reader; a recorded Heartbeat opens nothing to a later incarnation.
        number: the reader's first message number.
        sequence: the first sequence number under it, or a lower one: what the reader waited for and will not get.
        confirmed: below this a former incarnation of this reader had confirmed everything; 0: not known.
    """

    incarnation: int
    number: int
    sequence: int
    confirmed: int = 0


class Heartbeat(NamedTuple):
    """Messages from ``oldest`` on can be repaired; everything before (sent_number, sent_part) has been sent.

    Unsent messages are not announced, because readers would count them as lost. Sequence numbers below
    ``oldest_sequence`` belong to numbers below ``oldest``. Those below ``sent_sequence`` belong to numbers below
    ``sent_number``, or to none.
    """

    oldest: int
    sent_number: int
    sent_part: int
    starts: dict[bytes, StreamStart]  # by new reader
    description: bytes
    moves: tuple[Renumbering, ...] = ()  # the latest, oldest first; for readers that have not received them yet
    oldest_sequence: int = 0
    sent_sequence: int = 0
    gone: tuple[LostRange, ...] = ()  # messages that no reader can get, with the reason; the latest
    paces: tuple[tuple[bytes, int], ...] = ()  # of readers, which are to state them to their switches

    def to_wire(self) -> bytes:
        """Return the wire form."""
        place = self.oldest, self.oldest_sequence, self.sent_number, self.sent_part, self.sent_sequence
        head = _HEAD.pack(*place, len(self.starts), len(self.moves), len(self.gone) | _HAS_PACES * bool(self.paces))
        starts = b"".join(_START.pack(reader, *start) for reader, start in self.starts.items())
        moves = b"".join(_MOVE.pack(*each) for each in self.moves)
        gone = b"".join(_GONE.pack(*each) for each in self.gone)
        paces = b"".join(_PACE.pack(*each) for each in self.paces)
        count = bytes([len(self.paces)]) if self.paces else b""
        return head + starts + moves + gone + count + paces + self.description

    @classmethod
    def from_wire(cls, wire: bytes) -> Heartbeat:
        """Read the wire form. Raises ``FrameError``: too short for what it announces."""
        if len(wire) < _HEAD.size:
            raise FrameError(DropReason.TRUNCATED, "status")
        oldest, oldest_sequence, sent_number, sent_part, sent_sequence, starts, moves, gone = _HEAD.unpack_from(wire)
        has_paces, gone = gone & _HAS_PACES > 0, gone & ~_HAS_PACES
        moves_at = _HEAD.size + starts * _START.size
        gone_at = moves_at + moves * _MOVE.size
        paces_at = end = gone_at + gone * _GONE.size
        if has_paces:
            paces_at += 1
            end = paces_at + _PACE.size * (wire[paces_at - 1] if paces_at <= len(wire) else PACES_MAX + 1)
        too_many = (
            starts > STARTS_MAX or moves > MOVES_MAX or gone > GONE_MAX or end - paces_at > PACES_MAX * _PACE.size
        )
        if too_many or len(wire) < end or oldest > sent_number:
            raise FrameError(DropReason.MALFORMED, "status")
        moved = tuple(Renumbering(*each) for each in _MOVE.iter_unpack(wire[moves_at:gone_at]))
        if any(move.first + move.span >= move.to or 2 * move.to - move.first > NUMBER_MAX for move in moved):
            raise FrameError(DropReason.MALFORMED, "status")
        started = {reader: StreamStart(*start) for reader, *start in _START.iter_unpack(wire[_HEAD.size : moves_at])}
        lost = tuple(_range(*each) for each in _GONE.iter_unpack(wire[gone_at : paces_at - has_paces]))
        paces = tuple((reader, pace) for reader, pace in _PACE.iter_unpack(wire[paces_at:end]))
        description, sequences = wire[end:], (oldest_sequence, sent_sequence)
        return cls(oldest, sent_number, sent_part, started, description, moved, *sequences, lost, paces)


def _range(first: int, last: int, reason: int) -> LostRange:
    """Return a range as read. Raises ``FrameError``: it is invalid. A reason of a later version counts as GIVEN_UP."""
    if first > last:
        raise FrameError(DropReason.MALFORMED, "status")
    return LostRange(first, last, LossReason(reason) if reason in _REASONS else LossReason.GIVEN_UP)
