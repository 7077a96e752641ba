"""Reordering buffer of one writer's messages: complete messages wait behind a gap.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from gdp.limits import REPLAY_WINDOW_MESSAGES
from gdp.message.reassembly import ReassembledMessage
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.message.renumbering import Renumbering
from gdp.names import Name

__all__ = ["ReorderingBuffer"]

_OVERHEAD_BYTES: Final = 256  # what a waiting message costs in addition to its bytes


class ReorderingBuffer:
    """Messages by number, and the number that is delivered next.

    Args:
        budget: memory of all writer proxies; waiting messages are reserved there.

    Attributes:
        expected: the number that is delivered next.
    """

    def __init__(self, publisher: Name, budget: ReassemblyQuota) -> None:
        self._publisher = publisher
        self._budget = budget
        self._waiting: dict[int, ReassembledMessage] = {}
        self.expected = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def __contains__(self, number: int) -> bool:
        return number in self._waiting

    @property
    def numbers(self) -> list[int]:
        """Return the numbers that wait, lowest first."""
        return sorted(self._waiting)

    def put(self, reassembled: ReassembledMessage) -> bool:
        """Add a message; return False if the budget is exhausted."""
        if not self._budget.reserve(self._publisher, len(reassembled.message) + _OVERHEAD_BYTES):
            return False
        self._waiting[reassembled.number] = reassembled
        return True

    def consecutive(self) -> Iterator[ReassembledMessage]:
        """Remove and yield the messages from ``expected`` on, up to the next gap."""
        while self.expected in self._waiting:
            reassembled = self._pop(self.expected)
            self.expected += 1
            yield reassembled

    def skip_to(self, number: int) -> Iterator[ReassembledMessage]:
        """Advance to a number; remove and yield what waited before it."""
        before = sorted(each for each in self._waiting if each < number)
        self.expected = number
        return iter([self._pop(each) for each in before])

    def start_at(self, number: int) -> None:
        """Set the first expected number; what waits too far from it is dropped."""
        self.expected = number
        for each in [each for each in self._waiting if not 0 <= each - number < REPLAY_WINDOW_MESSAGES]:
            self._pop(each)

    def renumber(self, move: Renumbering) -> list[ReassembledMessage]:
        """Expect the new numbers of a renumbering; remove and return what waited, under its new numbers."""
        self.expected = move.new_number(self.expected)
        early = {number: self._pop(number) for number in list(self._waiting) if move.is_before(number)}
        for number in [number for number in self._waiting if number < self.expected]:
            self._pop(number)  # it was delivered under its old number
        return [reassembled._replace(number=move.new_number(old)) for old, reassembled in early.items()]

    def poll_all(self) -> list[ReassembledMessage]:
        """Remove and return what waits, in order."""
        return [self._pop(number) for number in self.numbers]

    def _pop(self, number: int) -> ReassembledMessage:
        reassembled = self._waiting.pop(number)
        self._budget.release(self._publisher, len(reassembled.message) + _OVERHEAD_BYTES)
        return reassembled
