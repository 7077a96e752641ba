"""Messages that had to be split anew, and so got new numbers: the links had become too narrow for their frames.

Place: pure. Source: docs/explanation/design.md, section 4: what must be split anew gets a new number.

All that a publisher keeps moves together, in order; the number between the old ones and the new ones stays unused, so
that every number is either an old or a new one::

    old   first ... end-1   end   ->   new   to ... to+span-1   to+span        end = first + span = to - 1

A reader whose next message would have been ``first + n`` goes on at ``to + n``, with what it has of the old ones under
their new numbers. So nothing comes twice, and nothing out of order.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["MOVES_MAX", "Renumbering"]

MOVES_MAX = 16  # that a publisher repeats; a reader that missed more has been silent for long


class Renumbering(NamedTuple):
    """Messages ``first`` to ``first + span - 1`` go on as ``to`` and what follows it."""

    first: int
    span: int
    to: int

    def is_before(self, number: int) -> bool:
        """Return whether a number is of the time before the move."""
        return number < self.to

    def of(self, number: int) -> int:
        """Return the new number of a message: of one that is kept no more the first, of a new one its own."""
        return number if number >= self.to else self.to + max(number - self.first, 0)
