"""Calls of one service that are under way: which caller waits for which response, and until when.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/design.md, section 6: the first
response wins. A call ends once: by its first response, by its timeout, or with all others. Whatever comes for it later
finds no call.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Generic, TypeVar

from gdp.due_queue import DueQueue
from gdp.errors import LocalError

T = TypeVar("T")

_NUMBERS: Final = 1 << 64


class Calls(Generic[T]):
    """Calls under way, each with its caller's context.

    Args:
        start: the first call's number, random in 64 bits: no number of an earlier incarnation recurs.
    """

    def __init__(self, limit: int, start: int) -> None:
        self._limit = limit
        self._next = start % _NUMBERS
        self._contexts: dict[int, T] = {}  # in the order of their start
        self._timeouts = DueQueue[int]()

    def __len__(self) -> int:
        return len(self._contexts)

    def __contains__(self, number: int) -> bool:
        return number in self._contexts

    def __iter__(self) -> Iterator[tuple[int, T]]:
        """Yield numbers and contexts, the oldest first; calls may begin and end meanwhile."""
        return iter(list(self._contexts.items()))

    def add_call(self, now_s: float, timeout_s: float | None, context: T) -> int:
        """Add a call and return its number; no number recurs.

        Args:
            timeout_s: how long it may take; None: no limit.
            context: what ``end``, ``expired`` or ``fail_all`` returns.

        Raises:
            LocalError: the limit of calls under way is reached.
        """
        if len(self._contexts) >= self._limit:
            raise LocalError(f"{self._limit} calls are under way: no more at once")
        number = self._next
        self._next = (number + 1) % _NUMBERS
        self._contexts[number] = context
        if timeout_s is not None:
            self._timeouts.put(number, now_s + timeout_s)
        return number

    def get(self, number: int) -> T | None:
        """Return the context of a call under way, or None."""
        return self._contexts.get(number)

    def end(self, number: int) -> T | None:
        """End a call; return its context, or None where it ended before."""
        self._timeouts.discard(number)
        return self._contexts.pop(number, None)

    def expired(self, now_s: float) -> list[tuple[int, T]]:
        """End the calls whose timeout has passed; return their numbers and contexts, the longest overdue first."""
        return [(number, self._contexts.pop(number)) for number in self._timeouts.poll_due(now_s)]

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timeout, or None."""
        return self._timeouts.next_due()

    def fail_all(self) -> list[tuple[int, T]]:
        """End every call, since no server is left to respond; return their numbers and contexts, the oldest first."""
        ended = list(self._contexts.items())
        self._contexts.clear()
        self._timeouts.clear()
        return ended
