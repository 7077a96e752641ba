"""Queries to the tier above: for which askers, and when each is repeated.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A query that stays open too long gets the response "unknown",
rather than a timeout at the asker. The query of a watched name is sent again while the watch and the lease of the
response last, and repeated until a response comes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.names import Name
from gdp.rib.watches import Asker

__all__ = ["RETRY_S", "WATCH_AGAIN_S", "DueQuery", "UpstreamQueries"]

RETRY_S: Final = 0.3
GIVE_UP_S: Final = 1.2
WATCH_AGAIN_S: Final = 6.0
_RENEWAL_TRIES_MAX: Final = 5  # the pause doubles after each; then the next renewal
OPEN_MAX: Final = 65_536
_NEVER_S: Final = float("inf")


class DueQuery(NamedTuple):
    """A query to send now.

    Attributes:
        watch_s: for how long to watch the name above.
        again_s: when it is sent again unless a response comes.
        is_unanswered: the last one had no response, or nothing has for a while.
    """

    name: Name
    watch_s: float
    again_s: float
    is_unanswered: bool


@dataclass(slots=True)
class _Open:
    asked_s: float
    again_s: float
    askers: list[Asker] = field(default_factory=list)
    watch_until_s: float = 0.0
    is_answered: bool = False
    renewals: int = 0  # of the watch, sent since the last response


class UpstreamQueries:
    """Queries to the tier above.

    Args:
        is_top: there is no tier above: no query is ever sent.
    """

    def __init__(self, *, is_top: bool) -> None:
        self._is_top = is_top
        self._open: dict[Name, _Open] = {}
        self._due_s = _NEVER_S  # no query is due before

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
            question.askers, question.renewals = [], 0
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

    def answered(self, name: Name, now_s: float, lease_s: float = _NEVER_S) -> list[Asker]:
        """Record a response; return the askers that waited for it. More responses may come for the same askers.

        Args:
            lease_s: how long the response counts.
        """
        question = self._open.get(name)
        if question is None:
            return []
        again_s = now_s + max(min(WATCH_AGAIN_S, lease_s / 3), RETRY_S)
        if not question.is_answered or question.renewals:
            question.is_answered, question.renewals, question.again_s = True, 0, again_s
        question.again_s = min(question.again_s, again_s)  # another update renews no watch, but its lease may be short
        self._due_s = min(self._due_s, question.again_s)
        return list(question.askers)

    def not_known(self, name: Name, now_s: float) -> list[Asker]:
        """Record that the tier above does not know a name; return the askers. The next renewal is an unanswered one."""
        askers = self.answered(name, now_s)
        if askers or name in self._open:
            self._open[name].renewals = 1
        return askers

    def due(self, now_s: float, *, is_silent: bool = False) -> tuple[list[DueQuery], list[tuple[Name, list[Asker]]]]:
        """Return the queries to send now, and those given up, as (name, askers).

        Args:
            is_silent: the tier above responds to nothing: renewals are not repeated sooner than usual.
        """
        ask: list[DueQuery] = []
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
            is_unanswered = is_silent or not question.is_answered or question.renewals > 0
            if question.is_answered:
                question.again_s = now_s + self._repeat_s(question, is_silent=is_silent)
            else:
                question.again_s = now_s + RETRY_S
            ask.append(DueQuery(name, self.watch_s(name), question.again_s, is_unanswered))
        self._due_s = min((question.again_s for question in self._open.values()), default=_NEVER_S)
        return ask, given_up

    @staticmethod
    def _repeat_s(question: _Open, *, is_silent: bool) -> float:
        """Count a renewal; return the seconds until it is repeated, unless its response comes."""
        again_s = RETRY_S * 2.0 ** (question.renewals % _RENEWAL_TRIES_MAX)
        question.renewals += 1
        return WATCH_AGAIN_S if is_silent or question.renewals % _RENEWAL_TRIES_MAX == 0 else again_s

    def next_due(self) -> float | None:
        """Return a monotonic second that is no later than the next query, or None."""
        return self._due_s if self._open else None
