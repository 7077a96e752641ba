"""Pending calls of a replicated log: each waits until one replica has applied its entry."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

from gdp.names import Name
from gdp.service.calls import Calls
from gdp.service.dispatch import Failure

A = TypeVar("A")

CALLS_MAX: Final = 65_536


@dataclass(slots=True, eq=False)
class _Call(Generic[A]):
    answered: Callable[[A], None]
    failed: Callable[[Failure, str], None]
    refused: set[Name] = field(default_factory=set)


class Pending(Generic[A]):
    """Calls under way; each ends once.

    Args:
        start: the first call's number.
    """

    def __init__(self, start: int) -> None:
        self._calls: Calls[_Call[A]] = Calls(CALLS_MAX, start)

    def __len__(self) -> int:
        return len(self._calls)

    def begin(
        self,
        now_s: float,
        timeout_s: float | None,
        answered: Callable[[A], None],
        failed: Callable[[Failure, str], None],
    ) -> int:
        """Begin a call and return its number, one above the last.

        Raises:
            LocalError: the limit of calls under way is reached.
        """
        return self._calls.add_call(now_s, timeout_s, _Call(answered, failed))

    def handle_response(self, number: int, answer: A) -> bool:
        """Complete a call with its response; return whether it was still under way."""
        call = self._calls.end(number)
        if call is not None:
            call.answered(answer)
        return call is not None

    def refuse(self, number: int, server: Name, reason: str, asked: Set[Name]) -> None:
        """Handle a replica's refusal; fail the call when all replicas that were asked refuse."""
        call = self._calls.get(number)
        if call is not None:
            call.refused.add(server)
            if call.refused >= asked:
                self._calls.end(number)
                call.failed(Failure.REFUSED, reason)

    def fail_expired(self, now_s: float) -> None:
        """Fail the calls whose timeout has passed."""
        for _, call in self._calls.expired(now_s):
            call.failed(Failure.TIMED_OUT, "")

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timeout, or None."""
        return self._calls.get_timer()

    def fail_all(self, failure: Failure, reason: str) -> None:
        """Fail every call."""
        for _, call in self._calls.fail_all():
            call.failed(failure, reason)
