"""Ledger of one publisher's sequence numbers: their message numbers, and the messages that were not confirmed.

Sans-I/O. A message number belongs to one sealed unit, which may be a bundle of several messages. A sequence number
belongs to each message that the application published, sealed or not.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from typing import Final

from gdp.message.loss import GONE_MAX, Losses, LossReason, LostRange, RangeSet, append
from gdp.message.renumbering import Renumbering

_TIMES_MAX: Final = 64  # messages whose time of publication is remembered; every second one goes when they are more


class Ledger:
    """Sequence numbers of one publisher.

    Args:
        last: the highest sequence number that was used before.

    Attributes:
        last: the highest sequence number in use.
        losses: messages that a reader should have received from this publisher, and did not.
        gone: the latest ranges that no reader can get, for Heartbeats.
    """

    def __init__(self, last: int) -> None:
        self._before = last
        self.last = last
        self.losses = Losses()
        self.gone: deque[LostRange] = deque(maxlen=GONE_MAX)
        self._unconfirmed = RangeSet()
        self._numbers: dict[int, int] = {}  # sequence number -> message number of one that carries nothing else
        self._of: dict[int, tuple[int, int]] = {}  # message number -> first sequence number, messages; numbers rise
        self._times: list[tuple[float, int]] = []  # when a message was published, its sequence number
        self._gap_s = 0.0  # what lies closer to the one before is not remembered

    @property
    def messages(self) -> int:
        """Return how many messages were published here."""
        return self.last - self._before

    def next(self, now_s: float | None = None) -> int:
        """Return the sequence number of a message that is published now."""
        self.last += 1
        if now_s is not None and (not self._times or now_s - self._times[-1][0] >= self._gap_s):
            self._times.append((now_s, self.last))
            if len(self._times) > _TIMES_MAX:
                self._times = self._times[::2]
                self._gap_s = (now_s - self._times[0][0]) / _TIMES_MAX
        return self.last

    def first_since(self, since_s: float) -> int:
        """Return the first sequence number known to be published since a second, or the next one."""
        index = bisect_left(self._times, (since_s, 0))
        return self._times[index][1] if index < len(self._times) else self.last + 1

    def put(self, number: int, sequence: int, messages: int) -> None:
        """Note what the newest message number carries."""
        self._of[number] = sequence, messages
        if messages == 1:
            self._numbers[sequence] = number

    def number_of(self, sequence: int) -> int | None:
        """Return the message number that carries one message alone; None: it is unknown, or carries others, too."""
        return self._numbers.get(sequence)

    def is_bundle(self, number: int) -> bool:
        """Return whether a message number carries several messages."""
        return self._of[number][1] > 1

    def begin_of(self, number: int, otherwise: int) -> int:
        """Return the first sequence number that a message number carries; ``otherwise`` if it is unknown."""
        known = self._of.get(number)
        return otherwise if known is None else known[0]

    def forget(self, below: int) -> None:
        """Forget message numbers under ``below``."""
        for number in [*self._of]:
            if number >= below:
                break
            sequence, _ = self._of[number]
            if sequence in self._numbers:
                del self._numbers[sequence]
            del self._of[number]

    def move(self, move: Renumbering) -> None:
        """Apply a renumbering."""
        self._of = {move.new_number(number): carried for number, carried in self._of.items()}
        self._numbers = {sequence: number for number, (sequence, messages) in self._of.items() if messages == 1}

    def record_evicted(self, numbers: Iterable[int], reason: LossReason) -> int:
        """Note that message numbers are gone before every reader had them; return how many messages they carried."""
        gone = 0
        for number in numbers:
            sequence, messages = self._of[number]
            self.lose(sequence, sequence + messages - 1, reason)
            gone += messages
        return gone

    def lose(self, first: int, last: int, reason: LossReason) -> None:
        """Note that no reader can get messages ``first`` to ``last`` any more."""
        append(self.gone, LostRange(first, last, reason))
        self.give_up(first, last, reason)

    def give_up(self, first: int, last: int, reason: LossReason = LossReason.GIVEN_UP) -> None:
        """Note that some reader does not get messages ``first`` to ``last``; none if ``last`` lies below ``first``."""
        if first <= last:
            self.losses.add(LostRange(first, last, reason))
            self._unconfirmed.add(first, last)

    def confirmed(self, below: int) -> int:
        """Return how many messages with sequence numbers under ``below`` were not given up for any reader."""
        return max(below - 1 - self._before - self._unconfirmed.count_below(below), 0)
