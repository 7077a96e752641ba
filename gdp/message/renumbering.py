"""Renumbering of messages that were fragmented again, because the path MTU fell below the size of their frames.

Sans-I/O. Source: docs/explanation/design.md, section 4: a message that is fragmented again gets a new number.

All messages that a publisher caches are renumbered together, in order. The number between the old ones and the new ones
stays unused, so that every number is either an old or a new one::

    old   first ... end-1   end   ->   new   to ... to+span-1   to+span        end = first + span = to - 1

A reader whose next message would have been ``first + n`` goes on at ``to + n``, with its old messages under their new
numbers. So no message comes twice or out of order.
"""

from __future__ import annotations

from typing import NamedTuple

MOVES_MAX = 16  # renumberings that a publisher repeats; a reader that missed more has been silent for long


class Renumbering(NamedTuple):
    """Messages ``first`` to ``first + span - 1`` go on as ``to`` and the numbers after it."""

    first: int
    span: int
    to: int

    def is_before(self, number: int) -> bool:
        """Return whether a number dates from before the renumbering."""
        return number < self.to

    def new_number(self, number: int) -> int:
        """Return the new number of a message: the first for one that is no longer cached, its own for a new one."""
        return number if number >= self.to else self.to + max(number - self.first, 0)
