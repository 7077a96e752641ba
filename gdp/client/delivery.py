"""Delivery of the messages of one writer: unbundles them in order, and accounts for those that are lost.

Sans-I/O. Sequence numbers under the seal show what is lost between two messages. Heartbeats show what is lost behind
the last, and why.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import Final, NamedTuple

from gdp.errors import DropReason, RemoteError
from gdp.frame.kinds import Flag
from gdp.limits import NUMBER_MAX, SEQUENCE_BYTES
from gdp.message.bundle import unpack
from gdp.message.loss import Losses, LossReason, LostRange, explain
from gdp.message.reassembly import ReassembledMessage

__all__ = ["Delivered", "DeliveryQueue"]

_BUNDLE: Final = int(Flag.BUNDLE)


class Delivered(NamedTuple):
    """One message, opened, verified and in order."""

    publisher: bytes
    incarnation: int  # of the publisher, within which numbers rise
    number: int
    message: bytes
    parts: int
    hops: int
    place: int = 0  # index among the messages of one number: a bundle has several
    # which message of its publisher's incarnation this is, from 1; a skipped number is a lost message
    sequence: int = 0


class DeliveryQueue:
    """Messages in order, for the application.

    Args:
        drops: counts malformed messages.

    Attributes:
        is_reliable: messages between two delivered ones were given up by the writer; else they are gaps.
        sequence: sequence number of the next message.
        known: lowest sequence number of unknown fate.
        gone: ranges that the writer reports as lost for every reader.
        skipped: why the next gap is skipped; None: unknown.
        losses: messages that were lost.
        delivered: messages that were delivered.
        delivered_bytes: size of what was passed to ``deliver``.
    """

    def __init__(self, publisher: bytes, incarnation: int, drops: Counter[DropReason]) -> None:
        self._publisher = publisher
        self._incarnation = incarnation
        self._drops = drops
        self._queue: deque[Delivered] = deque()
        self.is_reliable = False
        self.sequence = 0
        self.known = 0
        self.gone: tuple[LostRange, ...] = ()
        self.skipped: LossReason | None = None
        self.losses = Losses()
        self.delivered = 0
        self.delivered_bytes = 0

    def __len__(self) -> int:
        return len(self._queue)

    @property
    def gap_reason(self) -> LossReason:
        """Return the reason of losses for which no other reason is known."""
        return LossReason.GIVEN_UP if self.is_reliable else LossReason.GAP

    def record_published(self, sequence: int) -> None:
        """Note that messages before a sequence number were published."""
        self.known = max(self.known, sequence)

    def lose_until(self, sequence: int, otherwise: LossReason) -> None:
        """Count what lies before a sequence number as lost, with reason ``otherwise`` if the writer gives none."""
        if self.sequence < sequence:
            for lost in explain(self.sequence, sequence - 1, self.gone, otherwise):
                self.losses.add(lost)
            self.sequence = sequence

    def deliver(self, reassembled: ReassembledMessage) -> None:
        """Queue the messages of a number, and count what lies before them as lost; a malformed one is dropped."""
        sequence, messages = int.from_bytes(reassembled.head, "big"), [reassembled.message]
        self.delivered_bytes += len(reassembled.message)
        if len(reassembled.head) < SEQUENCE_BYTES or sequence > NUMBER_MAX:
            self._drops[DropReason.MALFORMED] += 1
            return
        if reassembled.flags & _BUNDLE:
            try:
                messages = unpack(reassembled.message)
            except RemoteError as error:
                self._drops[error.reason] += 1
                return
        otherwise, self.skipped = self.skipped or self.gap_reason, None
        self.lose_until(sequence, otherwise)
        self.sequence = max(self.sequence, sequence + len(messages))
        self.delivered += len(messages)
        number, way = reassembled.number, (reassembled.parts, reassembled.hops)
        for place, message in enumerate(messages):
            at = place, sequence + place
            self._queue.append(Delivered(self._publisher, self._incarnation, number, message, *way, *at))

    def poll(self) -> list[Delivered]:
        """Remove and return what is queued, in order."""
        delivered = list(self._queue)
        self._queue.clear()
        return delivered
