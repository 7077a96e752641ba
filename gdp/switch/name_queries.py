"""Queries for names: which names a switch queries at its RIB, and when each is due again.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A query is repeated until a response comes. A name that attached readers want, or that frames are sent to, is watched:
its query is sent again before the watch ends, so that a RIB that restarted learns of the watch. A link that loses
frames loses both this renewal and the RIB's updates, so the renewal is repeated, too (``gdp/requests.py``).

At most ``WINDOW`` queries for new names are in flight, so that a switch queries at the pace at which the RIB responds.
Otherwise repeated queries would lengthen the queue at the RIB, and no response would come in time. Names that wait for
the window are served round robin by owner.

An answer may not help the frames that wait: the node was attached here and is silent, which the RIB does not know yet.
They ask again. So a query follows the one before after ``RETRY_S`` at the soonest, answered or not. A RIB that does not
know a name is passed over: the query goes to the next one at once, as long as there is another.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final

from gdp.intervals import ADVERTISEMENT, NEVER_S
from gdp.limits import PENDING_S
from gdp.message.fair_queue import FairQueue
from gdp.names import Name
from gdp.requests import Backoff, Requests

__all__ = ["BATCH_MAX", "QUERIES_MAX", "RETRY_S", "TRIES_MAX", "USED_NAMES_MAX", "WINDOW", "NameQueries"]

RETRY_S: Final = 0.25
TRIES_MAX: Final = 8
_QUERIES: Final = Backoff(RETRY_S, 2.0, equal=TRIES_MAX)
_RENEWALS: Final = 3  # repeated soon; on a link whose queue is full, more would keep it full
WINDOW: Final = 128  # a tenth of a second's work of a RIB
QUERIES_MAX: Final = 4_096  # open at once, watches of readers not counted; each costs a signature at every try
BATCH_MAX: Final = 64  # queries in one call, some 10 ms: a switch has other work
USED_NAMES_MAX: Final = 8_192  # names watched because frames are sent to them


@dataclass(slots=True, kw_only=True)
class _Query:
    since_s: float
    owner: bytes = b""  # the neighbour whose share it uses
    sent_s: float = -NEVER_S
    is_watch: bool = False  # an attached reader needs all advertisers of the name
    used_until_s: float = 0.0  # frames are sent to the name
    passed_over: set[Name] = field(default_factory=set)  # RIBs that do not know the name


class NameQueries:
    """The queries of one switch, by name.

    Args:
        watch_s: seconds for which the RIB keeps a reader's watch; it is renewed after a quarter of them. A name that
            frames are sent to is watched for twice as long after the last use.
    """

    def __init__(self, watch_s: float = ADVERTISEMENT.lease_s) -> None:
        self.watch_s = watch_s
        self._use_watch_s = 2 * watch_s
        self._watch_renewals = Backoff(RETRY_S, watch_s / 4, growing=_RENEWALS)
        self._use_renewals = Backoff(RETRY_S, watch_s / 2, growing=_RENEWALS)
        self._queries: dict[Name, _Query] = {}
        self._requests = Requests[Name]()
        self._new = FairQueue[Name]()  # names that wait for the window, by owner
        self._in_flight: set[Name] = set()  # in the window
        self._watches = 0

    def __len__(self) -> int:
        return len(self._queries)

    def __contains__(self, name: Name) -> bool:
        return name in self._queries

    def request(self, name: Name, now_s: float, owner: bytes = b"") -> None:
        """Query a name unless a query is open; a query with a response is sent again, ``RETRY_S`` after the last time.

        Nothing happens where ``QUERIES_MAX`` are open: ``name in queries`` stays False.

        Args:
            owner: the neighbour whose share of the window the query uses; empty: this switch.
        """
        query = self._queries.get(name)
        if query is None:
            if len(self._queries) - self._watches < QUERIES_MAX:
                self._add(name, _Query(since_s=now_s, owner=owner), NEVER_S)
                self._new.put(owner, name)
        elif not self._requests.is_open(name):
            self._requests.start(name, max(now_s, query.sent_s + RETRY_S))

    def is_open(self, name: Name) -> bool:
        """Return whether a query for a name has no response yet."""
        return self._requests.is_open(name)

    def watch(self, name: Name, now_s: float) -> None:
        """Query a name at once and watch it for attached readers, who proved their right: no bound applies."""
        query = self._queries.get(name)
        if query is None:
            query = self._add(name, _Query(since_s=now_s), now_s)
        if not query.is_watch:
            self._new.discard(query.owner, name)
            query.is_watch = True
            self._requests.hasten(name, now_s)
            self._watches += 1

    def unwatch(self, name: Name) -> None:
        """End the watch of a name for attached readers."""
        query = self._queries.get(name)
        if query is None:
            return
        if query.is_watch:
            query.is_watch = False
            self._watches -= 1
        if query.used_until_s == 0.0:
            self._remove(name)

    def use(self, name: Name, now_s: float) -> None:
        """Watch a name that frames are sent to, so that the switch learns where it moves.

        Above ``USED_NAMES_MAX`` the switch learns of moves by redirects alone.
        """
        query = self._queries.get(name)
        if query is None:
            if len(self._queries) - self._watches >= USED_NAMES_MAX:
                return
            query = self._add(name, _Query(since_s=now_s), now_s)
        query.used_until_s = now_s + self._use_watch_s

    def receive_answer(self, name: Name, now_s: float) -> None:
        """Close the query for a name, or schedule the renewal of its watch."""
        query = self._queries.get(name)
        if query is None:
            return
        query.passed_over.clear()
        if not self._is_needed(query, now_s):
            self._remove(name)
            return
        self._in_flight.discard(name)
        self._requests.answered(name, now_s + self._renewals(query).most_s)

    def receive_unknown(self, name: Name, rib: Name, now_s: float, others: AbstractSet[Name]) -> None:
        """Send the query for a name that a RIB does not know to another one, if one is left; else at its next time."""
        query = self._queries.get(name)
        if query is None:
            return
        query.passed_over.add(rib)
        if not others <= query.passed_over:
            self._requests.hasten(name, now_s)
        elif self._is_needed(query, now_s):
            self.receive_answer(name, now_s)
        else:
            query.passed_over.clear()

    def passed_over(self, name: Name) -> AbstractSet[Name]:
        """Return the RIBs that do not know a name, of this round of queries."""
        query = self._queries.get(name)
        return frozenset() if query is None else query.passed_over

    def repeat_all(self, now_s: float) -> None:
        """Send every open query and every watch again at once: there is a new RIB."""
        self._requests.start_all(now_s)

    def poll_due(self, now_s: float) -> tuple[list[tuple[Name, float]], list[Name]]:
        """Return at most ``BATCH_MAX`` queries to send now, as (name, seconds to watch it), and the failed names."""
        queries: list[tuple[Name, float]] = []
        failed: list[Name] = []
        for name in self._requests.poll_due(now_s, BATCH_MAX):
            query, is_open = self._queries[name], self._requests.is_open(name)
            if self._is_needed(query, now_s) or (is_open and self._requests.tries(name) < TRIES_MAX):
                queries.append((name, self._sent(name, query, now_s)))
                continue
            self._remove(name)
            if is_open:
                failed.append(name)
        while len(queries) < BATCH_MAX and self._is_window_ready():
            name = self._new.pop()
            query = self._queries[name]
            if now_s >= query.since_s + PENDING_S:  # the frame that needs it has expired
                self._remove(name)
                failed.append(name)
                continue
            self._in_flight.add(name)
            queries.append((name, self._sent(name, query, now_s)))
        return queries, failed

    def next_due(self) -> float | None:
        """Return a monotonic second that is no later than the next query, or None."""
        return -NEVER_S if self._is_window_ready() else self._requests.next_due()

    def _is_window_ready(self) -> bool:
        """Return whether a new name waits and the window has space for it."""
        return bool(self._new) and len(self._in_flight) < WINDOW

    def _sent(self, name: Name, query: _Query, now_s: float) -> float:
        """Record one try of a query; return for how many seconds the RIB shall watch its name."""
        query.sent_s = now_s
        self._requests.sent(name, now_s, _QUERIES if self._requests.is_open(name) else self._renewals(query))
        return self.watch_s if query.is_watch else self._use_watch_s if query.used_until_s > now_s else 0.0

    def _renewals(self, query: _Query) -> Backoff:
        """Return the pauses of a watch: those of its repetitions, up to the time after which it is renewed."""
        return self._watch_renewals if query.is_watch else self._use_renewals

    @staticmethod
    def _is_needed(query: _Query, now_s: float) -> bool:
        return query.is_watch or query.used_until_s > now_s

    def _add(self, name: Name, query: _Query, at_s: float) -> _Query:
        self._queries[name] = query
        self._requests.start(name, at_s)
        return query

    def _remove(self, name: Name) -> None:
        self._new.discard(self._queries.pop(name).owner, name)
        self._in_flight.discard(name)
        self._requests.cancel(name)
