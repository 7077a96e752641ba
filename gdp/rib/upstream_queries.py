"""Queries to the tier above: for which askers, and when each is repeated.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A query that stays open too long gets a negative response,
rather than a timeout at the asker.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from gdp.names import Name
from gdp.rib.watches import Asker

__all__ = ["UpstreamQueries"]

RETRY_S: Final = 0.3
GIVE_UP_S: Final = 1.2
WATCH_AGAIN_S: Final = 6.0
OPEN_MAX: Final = 65_536


@dataclass(slots=True)
class _Open:
    asked_s: float
    again_s: float
    askers: list[Asker] = field(default_factory=list)
    watch_until_s: float = 0.0
    is_answered: bool = False


class UpstreamQueries:
    """Queries to the tier above.

    Args:
        is_top: there is no tier above: no query is ever sent.
    """

    def __init__(self, *, is_top: bool) -> None:
        self._is_top = is_top
        self._open: dict[Name, _Open] = {}
        self._due_s = float("inf")  # no query is due before

    def request(self, name: Name, asker: Asker, watch_s: float, now_s: float, *, is_known: bool) -> bool:
        """Record an asker's query; return whether a query to the tier above must be sent now.

        A known name is queried only when it is watched: others may advertise it elsewhere.
        """
        if self._is_top or (is_known and watch_s == 0):
            return False
        question = self._open.get(name)
        is_new = question is None
        if question is None:
            if len(self._open) >= OPEN_MAX:
                return False
            question = self._open[name] = _Open(now_s, now_s + RETRY_S)
        question.watch_until_s = max(question.watch_until_s, now_s + watch_s if watch_s else 0.0)
        if question.is_answered and not is_known:
            question.is_answered, question.asked_s, question.again_s = False, now_s, now_s + RETRY_S
            question.askers = []
            is_new = True
        if is_new:
            self._due_s = min(self._due_s, question.again_s)
        if not question.is_answered and not is_known and asker not in question.askers:
            question.askers.append(asker)
        return is_new

    def ask_again(self, now_s: float) -> None:
        """Make every open query and every watch due at once: there is another RIB above."""
        for question in self._open.values():
            question.again_s = now_s
        self._due_s = min(self._due_s, now_s)

    def watch_s(self, name: Name) -> float:
        """Return for how long to watch a name above: longer than until its query is repeated."""
        question = self._open.get(name)
        return 3 * WATCH_AGAIN_S if question is not None and question.watch_until_s else 0.0

    def is_waiting(self, name: Name) -> bool:
        """Return whether a response from above is still pending."""
        question = self._open.get(name)
        return question is not None and not question.is_answered

    def answered(self, name: Name, now_s: float) -> list[Asker]:
        """Record a response; return the askers that waited for it. More responses may come for the same askers."""
        question = self._open.get(name)
        if question is None:
            return []
        if not question.is_answered:  # a later update renews no watch
            question.is_answered = True
            question.again_s = now_s + WATCH_AGAIN_S
        return list(question.askers)

    def due(self, now_s: float) -> tuple[list[tuple[Name, float]], list[tuple[Name, list[Asker]]]]:
        """Return the queries to send now, as (name, watch seconds), and those given up, as (name, askers)."""
        ask: list[tuple[Name, float]] = []
        given_up: list[tuple[Name, list[Asker]]] = []
        if now_s < self._due_s:
            return ask, given_up
        for name, question in list(self._open.items()):
            if question.again_s > now_s:
                continue
            is_watched = question.watch_until_s > now_s
            if question.is_answered:
                question.askers = []
            if not question.is_answered and question.askers and now_s - question.asked_s >= GIVE_UP_S:
                given_up.append((name, question.askers))
                question.askers = []
            if not is_watched and (question.is_answered or not question.askers):
                del self._open[name]
                continue
            question.again_s = now_s + (WATCH_AGAIN_S if question.is_answered else RETRY_S)
            ask.append((name, self.watch_s(name)))
        self._due_s = min((question.again_s for question in self._open.values()), default=float("inf"))
        return ask, given_up

    def next_due(self) -> float | None:
        """Return a monotonic second that is no later than the next query, or None."""
        return self._due_s if self._open else None
