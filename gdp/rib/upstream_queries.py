"""Queries to the tier above: for which askers, and when each is repeated.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A query that stays open too long gets the response "unknown",
rather than a timeout at the asker. The query of a watched name is sent again while the watch and the lease of the
response last, and repeated until a response comes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.intervals import NEVER_S, SoftState, renew_after_s
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.rib.watches import Asker

RETRY_S: Final = 0.3
WATCH: Final = SoftState(6.0, periods=3)  # a query for changes
_QUERIES: Final = Backoff(RETRY_S, RETRY_S)  # four of them, until no RIB above counts as able to answer
_RENEWALS: Final = Backoff(RETRY_S, WATCH.refresh_s)
_SILENT: Final = Backoff(WATCH.refresh_s, WATCH.refresh_s)
OPEN_MAX: Final = 65_536


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
    askers: list[Asker] = field(default_factory=list)
    watch_until_s: float = 0.0
    is_unknown: bool = False  # the tier above did not know the name


class UpstreamQueries:
    """Queries to the tier above.

    Args:
        is_top: there is no tier above: no query is ever sent.
    """

    def __init__(self, *, is_top: bool) -> None:
        self._is_top = is_top
        self._open: dict[Name, _Open] = {}
        self._requests = Requests[Name]()

    def request(self, name: Name, asker: Asker, watch_s: float, now_s: float, *, is_known: bool) -> bool:
        """Record an asker's query; return whether a query to the tier above must be sent now.

        A known name is queried only when it is watched: others may advertise it elsewhere.
        """
        if self._is_top or (is_known and watch_s == 0):
            return False
        question = self._open.get(name)
        is_new = question is None or (not self._requests.is_open(name) and not is_known)
        if question is None:
            if len(self._open) >= OPEN_MAX:
                return False
            question = self._open[name] = _Open(now_s)
        question.watch_until_s = max(question.watch_until_s, now_s + watch_s if watch_s else 0.0)
        if is_new:
            question.asked_s, question.askers = now_s, []
            self._requests.start(name, now_s)
            self._requests.sent(name, now_s, _QUERIES)
        if self._requests.is_open(name) and not is_known and asker not in question.askers:
            question.askers.append(asker)
        return is_new

    def ask_again(self, now_s: float) -> None:
        """Make every open query and every watch due at once: there is another RIB above."""
        for name in self._open:
            self._requests.hasten(name, now_s)

    def watch_s(self, name: Name) -> float:
        """Return for how long to watch a name above: longer than until its query is repeated."""
        question = self._open.get(name)
        return WATCH.lease_s if question is not None and question.watch_until_s else 0.0

    def is_waiting(self, name: Name) -> bool:
        """Return whether a response from above is still pending."""
        return self._requests.is_open(name)

    def answered(self, name: Name, now_s: float, lease_s: float = NEVER_S, *, is_unknown: bool = False) -> list[Asker]:
        """Record a response; return the askers that waited for it. More responses may come for the same askers.

        Args:
            lease_s: how long the response counts.
            is_unknown: the tier above does not know the name: the next renewal is an unanswered one.
        """
        question = self._open.get(name)
        if question is None:
            return []
        again_s = now_s + max(min(WATCH.refresh_s, renew_after_s(lease_s)), RETRY_S)
        self._requests.answered(name, again_s)
        self._requests.hasten(name, again_s)  # another update renews no watch, but its lease may be short
        question.is_unknown = is_unknown
        return list(question.askers)

    def due(self, now_s: float, *, is_silent: bool = False) -> tuple[list[DueQuery], list[tuple[Name, list[Asker]]]]:
        """Return the queries to send now, and those given up, as (name, askers).

        Args:
            is_silent: the tier above responds to nothing: renewals are not repeated sooner than usual.
        """
        ask: list[DueQuery] = []
        given_up: list[tuple[Name, list[Asker]]] = []
        for name in self._requests.poll_due(now_s):
            question, is_open = self._open[name], self._requests.is_open(name)
            if not is_open:
                question.askers = []
            elif question.askers and now_s - question.asked_s >= 4 * RETRY_S:
                given_up.append((name, question.askers))
                question.askers = []
            if not question.askers and question.watch_until_s <= now_s:
                del self._open[name]
                self._requests.cancel(name)
                continue
            is_unanswered = is_silent or is_open or question.is_unknown or self._requests.tries(name) > 0
            self._requests.sent(name, now_s, _QUERIES if is_open else _SILENT if is_silent else _RENEWALS)
            ask.append(DueQuery(name, self.watch_s(name), self._requests.due_s(name), is_unanswered))
        return ask, given_up

    def next_due(self) -> float | None:
        """Return a monotonic second that is no later than the next query, or None."""
        return self._requests.next_due()
