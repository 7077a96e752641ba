"""Requests that are repeated until they are answered, and renewed afterwards: one schedule for every protocol.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: exponential backoff with a bound, as in RFC 6298,
section 5.5, and RFC 8415, section 15.

::

    start --due--> poll_due --sent--> waits a pause --due--> poll_due ...     the pauses grow with each try
                                        |
                                    answered(again_s) --due--> the renewal begins at the first pause again
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from gdp.due_queue import DueQueue

_GROWING_MAX: Final = 64  # 2**63 times the first pause is above every bound

K = TypeVar("K")


@dataclass(frozen=True, slots=True)
class Backoff:
    """Pauses between the tries of a request.

    Attributes:
        first_s: after the first try.
        most_s: bound of a pause.
        equal: how many pauses have one length, before the next ones are twice as long.
        growing: pauses below the bound; the later ones have that length.
    """

    first_s: float
    most_s: float
    equal: int = 1
    growing: int = _GROWING_MAX

    def pause_s(self, tries: int, estimate_s: float = 0.0) -> float:
        """Return the seconds to wait after so many tries; 0 counts as 1.

        Args:
            estimate_s: of the first pause, where an answer takes longer than ``first_s`` (RFC 6298, section 2.4).
        """
        if tries > self.growing:
            return self.most_s
        first_s = estimate_s if estimate_s > self.first_s else self.first_s
        pause_s = first_s * 2.0 ** ((tries - 1 if tries else 0) // self.equal)
        return pause_s if pause_s < self.most_s else self.most_s

    def after_s(self, pause_s: float) -> float:
        """Return the pause after one of this length."""
        return min(2 * pause_s, self.most_s)

    def random_pause_s(self, tries: int, chance: float) -> float:
        """Return the pause of one of many clients, which do not come back together.

        Args:
            chance: in [0, 1), random; the pause is between half of ``pause_s`` and all of it.
        """
        return self.pause_s(tries) * (1 + chance) / 2


@dataclass(slots=True)
class _State:
    tries: int = 0  # since it was started, or answered
    is_answered: bool = False


class Requests(Generic[K]):
    """Requests by key: how often each was tried, whether it is answered, and when it is due again.

    A key that ``poll_due`` returned is due no more until ``sent``, ``start`` or ``answered`` says when.

    Args:
        is_sorted: of requests that are due at once the lowest key comes first; else the one that was put first.
    """

    def __init__(self, *, is_sorted: bool = False) -> None:
        self._states: dict[K, _State] = {}
        self._due = DueQueue[K](is_sorted=is_sorted)

    def __len__(self) -> int:
        return len(self._states)

    def __contains__(self, key: K) -> bool:
        return key in self._states

    def keys(self) -> Set[K]:
        """Return the keys of all requests."""
        return self._states.keys()

    def tries(self, key: K) -> int:
        """Return how often a request was sent since it was started or answered."""
        state = self._states.get(key)
        return 0 if state is None else state.tries

    def is_open(self, key: K) -> bool:
        """Return whether a request waits for its first answer."""
        state = self._states.get(key)
        return state is not None and not state.is_answered

    def due_s(self, key: K, otherwise_s: float = float("inf")) -> float:
        """Return the monotonic second at which a request is due, or ``otherwise_s`` if it never is."""
        return self._due.due_s(key) if key in self._due else otherwise_s

    def start(self, key: K, at_s: float) -> None:
        """Have a request due at a second, as one that was neither tried nor answered; infinity: it is known only."""
        self._states[key] = _State()
        self._due.put(key, at_s)

    def hasten(self, key: K, at_s: float) -> None:
        """Have a request due at a second at the latest."""
        if key in self._states:
            self._due.put(key, min(at_s, self._due.due_s(key)))

    def start_all(self, now_s: float) -> None:
        """Have every request that has a time due now, with its first pause after it: another node responds from now."""
        for key, state in self._states.items():
            state.tries = 0
            if key in self._due:
                self._due.put(key, now_s)

    def sent(self, key: K, now_s: float, backoff: Backoff) -> None:
        """Record a try; the request is due again after a pause, unless it is answered."""
        state = self._states[key]
        state.tries += 1
        self._due.put(key, now_s + backoff.pause_s(state.tries))

    def answered(self, key: K, again_s: float = float("inf")) -> None:
        """Record an answer; the renewal is due at a second. One that nothing was sent for changes nothing."""
        state = self._states.get(key)
        if state is not None and (state.tries or not state.is_answered):
            state.tries, state.is_answered = 0, True
            self._due.put(key, again_s)

    def cancel(self, key: K) -> None:
        """Forget a request."""
        self._states.pop(key, None)
        self._due.discard(key)

    def poll_due(self, now_s: float, most: int | None = None) -> list[K]:
        """Return the requests that are due, the first one first."""
        return self._due.poll_due(now_s, most)

    def next_due(self) -> float | None:
        """Return the monotonic second at which the next request is due, or None."""
        return self._due.next_due()
