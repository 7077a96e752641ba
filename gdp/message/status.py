"""What a publisher tells its readers about its topic: what it still holds, where each begins, what the messages are.

Place: pure. It travels as a sealed and signed message. Wire form, big-endian: ``oldest (8) | sent number (8) | sent
part (4) | starts (2) | moves (1)``, for each start ``reader (32) | number (8)``, for each move ``first (8) | span (8)
| to (8)``, then the description, empty when this status brings none.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from gdp.errors import DropReason, FrameError
from gdp.limits import NUMBER_MAX
from gdp.message.move import MOVES_MAX, Move

__all__ = ["STARTS_MAX", "Status"]

STARTS_MAX: Final = 64  # readers that one status tells where to begin; more get the next one
_HEAD: Final = struct.Struct("!QQIHB")
_START: Final = struct.Struct("!32sQ")
_MOVE: Final = struct.Struct("!QQQ")


class Status(NamedTuple):
    """Messages from ``oldest`` on can be repaired; everything before (sent_number, sent_part) has been sent.

    What has not been sent is not announced: it would be taken for lost.
    """

    oldest: int
    sent_number: int
    sent_part: int
    starts: dict[bytes, int]  # new reader -> the first message that is its
    description: bytes
    moves: tuple[Move, ...] = ()  # the latest, oldest first; for readers that have not heard of them

    def to_wire(self) -> bytes:
        """Return the wire form."""
        head = _HEAD.pack(self.oldest, self.sent_number, self.sent_part, len(self.starts), len(self.moves))
        starts = b"".join(_START.pack(*each) for each in self.starts.items())
        return head + starts + b"".join(_MOVE.pack(*each) for each in self.moves) + self.description

    @classmethod
    def from_wire(cls, wire: bytes) -> Status:
        """Read the wire form.

        Raises:
            FrameError: too short for what it announces.
        """
        if len(wire) < _HEAD.size:
            raise FrameError(DropReason.TRUNCATED, "status")
        oldest, sent_number, sent_part, starts, moves = _HEAD.unpack_from(wire)
        moves_at = _HEAD.size + starts * _START.size
        end = moves_at + moves * _MOVE.size
        if starts > STARTS_MAX or moves > MOVES_MAX or len(wire) < end or oldest > sent_number:
            raise FrameError(DropReason.MALFORMED, "status")
        moved = tuple(Move(*each) for each in _MOVE.iter_unpack(wire[moves_at:end]))
        if any(move.first + move.span >= move.to or 2 * move.to - move.first > NUMBER_MAX for move in moved):
            raise FrameError(DropReason.MALFORMED, "status")
        started = dict(_START.iter_unpack(wire[_HEAD.size : moves_at]))
        return cls(oldest, sent_number, sent_part, started, wire[end:], moved)
