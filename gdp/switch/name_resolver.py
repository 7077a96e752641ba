"""Name resolution at a switch: what is known of each name, the queries to the RIB, and the frames that wait for them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). It works like the neighbour cache of RFC 4861, sections 5.1
and 7.2.2: a miss makes one query and keeps the frame; the response releases the frame, or its end drops it::

    frame without an entry (core.py)
      -> Unicast.forward -> resolve: a location, or why none -> table entry, and the frame goes on
                         `-> resolve: unknown                -> a query is open: buffer_frame
    timer of the core -> RibClient.send_queries -> queries_to_send    -> query to the RIB, repeated until a response
    response of a RIB -> RibClient.receive -> LocationUpdates.receive -> receive_location -> Unicast.release: the frame
                                           |-> receive_negative      -> the frame is dropped, counted
                                           `-> receive_unknown       -> known locations stay; the next RIB is queried
    timer of the core -> expire: leases, negative entries and pending frames end

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

from collections import Counter, OrderedDict, deque
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

from gdp.control.neighbour import Neighbour
from gdp.due_queue import earliest
from gdp.errors import DropReason
from gdp.intervals import ADVERTISEMENT, NEVER_S
from gdp.limits import PENDING_BYTES_MAX, PENDING_FRAMES_MAX, PENDING_S, QUESTIONS_RATE, SWITCH_QUESTIONS_RATE
from gdp.message.fair_queue import FairQueue
from gdp.message.shares import Shares
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.switch.name_cache import Location, NameCache
from gdp.token_bucket import TokenBuckets
from gdp.trust.right import Right

RETRY_S: Final = 0.25
TRIES_MAX: Final = 8
_QUERIES: Final = Backoff(RETRY_S, 2.0, equal=TRIES_MAX)
_RENEWALS: Final = 3  # repeated soon; on a link whose queue is full, more would keep it full
WINDOW: Final = 128  # a tenth of a second's work of a RIB
QUERIES_MAX: Final = 4_096  # open at once, watches of readers not counted; each costs a signature at every try
BATCH_MAX: Final = 64  # queries in one call, some 10 ms: a switch has other work
USED_NAMES_MAX: Final = 8_192  # names watched because frames are sent to them
_FROM_NODE: Final = b"n"  # begins an owner
_FROM_SWITCH: Final = b"s"
_ACCEPTS_FRAMES: Final = (Right.ATTACH, Right.SERVE)


Resolution: TypeAlias = list[Location] | DropReason  # where the advertisers of a name are, or why frames go to none


@dataclass(slots=True, kw_only=True)
class NameQuery:
    """A query for a name at the RIB, or the watch that is left of it.

    Attributes:
        owner: the neighbour whose share of the window it uses.
        is_watch: an attached reader needs all advertisers of the name.
        used_until_s: frames are sent to the name; 0: none were.
        watch_s: seconds for which the RIB shall watch the name, of the last try.
        passed_over: RIBs that do not know the name, of this round.
    """

    name: Name
    since_s: float
    owner: bytes = b""
    sent_s: float = -NEVER_S
    is_watch: bool = False
    used_until_s: float = 0.0
    watch_s: float = 0.0
    passed_over: set[Name] = field(default_factory=set)

    def is_needed(self, now_s: float) -> bool:
        """Return whether the name is watched, so that the query is renewed after a response."""
        return self.is_watch or self.used_until_s > now_s


def owner_of(neighbour: Neighbour) -> bytes:
    """Return the owner of the queries and pending frames that a neighbour causes."""
    return (_FROM_SWITCH if neighbour.role.is_switch else _FROM_NODE) + neighbour.name


class NameResolver:
    """Resolves the names of one switch.

    Args:
        me: this switch.
        lease_s: seconds for which the RIB keeps a reader's watch; it is renewed after a quarter of them. A name that
            frames are sent to is watched for twice as long after the last use.

    Attributes:
        cache: the locations that are known.
        pending: frames that wait for a response.
        requests: the queries, by name; an answered one is a watch.
    """

    def __init__(self, me: Name, lease_s: float = ADVERTISEMENT.lease_s) -> None:
        self._me = me
        self._watch_s = lease_s
        self._watch_renewals = Backoff(RETRY_S, lease_s / 4, growing=_RENEWALS)
        self._use_renewals = Backoff(RETRY_S, lease_s / 2, growing=_RENEWALS)
        self.cache = NameCache(lease_s)
        self.pending = PendingFrames()
        self.requests = Requests[Name]()
        self._queries: dict[Name, NameQuery] = {}
        self._new = FairQueue[Name]()  # names that wait for the window, by owner
        self._in_flight: set[Name] = set()  # in the window
        self._watches = 0
        self._rates = {
            _FROM_NODE: TokenBuckets(*QUESTIONS_RATE),
            _FROM_SWITCH: TokenBuckets(*SWITCH_QUESTIONS_RATE),
        }

    # -- a frame, or a reader

    def resolve(self, name: Name, now_s: float, owner: bytes = b"") -> Resolution | None:
        """Return where frames to a name go, or why to none; None after a query to the RIB.

        A name that resolves to another switch is watched from now on.

        Args:
            owner: as ``owner_of``, whose query rate applies; empty: this switch itself, without a limit.
        """
        known = self.cache.of(name, now_s)
        accepting = [location for location in known if location.right in _ACCEPTS_FRAMES]
        if not known and (node := self.cache.of_node(name, now_s)) is not None:
            accepting = [node]
        elsewhere = [location for location in accepting if location.switch != self._me]
        if elsewhere:
            self._use(name, now_s)
            return elsewhere
        if accepting or not (known or self.cache.is_negative(name, now_s)):  # it has left this switch, or is unknown
            self.request(name, now_s, owner)
            return None
        return DropReason.NO_READER if known else DropReason.NO_ROUTE

    def resolve_any(self, name: Name, now_s: float, owner: bytes = b"") -> Resolution | None:
        """Return where the advertisers of a name are attached, whatever their rights; else as ``resolve``.

        Args:
            owner: as in ``resolve``.
        """
        known = self.cache.of(name, now_s)
        if known:
            self._use(name, now_s)
            return known
        if self.cache.is_negative(name, now_s):
            return DropReason.NO_ROUTE
        self.request(name, now_s, owner)
        return None

    def request(self, name: Name, now_s: float, owner: bytes = b"") -> None:
        """Query a name unless a query is open; a query with a response is sent again, ``RETRY_S`` after the last time.

        Nothing happens where ``QUERIES_MAX`` are open, or the owner exceeds its rate.

        Args:
            owner: as in ``resolve``; the query uses its share of the window.
        """
        query, rate = self._queries.get(name), self._rates.get(owner[:1])
        if query is not None:
            if not self.requests.is_open(name):
                self.requests.start(name, max(now_s, query.sent_s + RETRY_S))
        elif (rate is None or rate.spend(owner, now_s)) and len(self._queries) - self._watches < QUERIES_MAX:
            self._add(name, now_s, NEVER_S, owner)
            self._new.put(owner, name)

    def buffer_frame(self, name: Name, frame: bytes, now_s: float, owner: bytes, until_s: float | None = None) -> None:
        """Buffer a frame until the response for its name, or until ``until_s`` (default: for ``PENDING_S``).

        The frame is dropped where no query for the name is open, too many are, or its owner exceeds its rate.
        """
        if name in self._queries:
            self.pending.park(name, frame, now_s, until_s, owner=owner)
        else:
            self.pending.drops[DropReason.PENDING_FULL] += 1

    def watch(self, name: Name, now_s: float) -> None:
        """Query a name at once and watch it for attached readers, who proved their right: no bound applies."""
        query = self._queries.get(name) or self._add(name, now_s, now_s)
        if not query.is_watch:
            self._new.discard(query.owner, name)
            query.is_watch = True
            self.requests.hasten(name, now_s)
            self._watches += 1

    def unwatch(self, name: Name) -> None:
        """End the watch of a name for attached readers."""
        if (query := self._queries.get(name)) is None:
            return
        if query.is_watch:
            query.is_watch = False
            self._watches -= 1
        if query.used_until_s == 0.0:
            self._remove(name)

    def _use(self, name: Name, now_s: float) -> None:
        """Watch a name that frames are sent to, so that the switch learns where it moves.

        Above ``USED_NAMES_MAX`` the switch learns of moves by redirects alone.
        """
        query = self._queries.get(name)
        if query is None:
            if len(self._queries) - self._watches >= USED_NAMES_MAX:
                return
            query = self._add(name, now_s, now_s)
        query.used_until_s = now_s + 2 * self._watch_s

    # -- a response

    def receive_location(
        self, location: Location, now_s: float, *, is_ours: bool = False, has_left: bool = False
    ) -> None:
        """Store a verified location.

        Args:
            is_ours: its advertiser is attached here. The RIB echoes an advertisement to the switch that relayed it; the
                first echo answers no query, the second one does.
            has_left: its advertiser was attached here and is not any more. The RIB does not know that yet, so the query
                stays open.
        """
        before = self.cache.put(location)
        is_repeated = before is not None and before.advertisement == location.advertisement
        query = self._queries.get(location.name)
        if location.right not in _ACCEPTS_FRAMES and query is not None and not query.is_needed(now_s):
            # frames that wait for a server that has left ask on: where its clients are does not help them
            known = self.cache.of(location.name, now_s)
            has_left |= any(each.switch == self._me and each.right in _ACCEPTS_FRAMES for each in known)
        if not has_left and (not is_ours or is_repeated):
            self._answered(location.name, now_s, location.expires_s - now_s)

    def receive_removal(self, name: Name, advertiser: Name, now_s: float) -> None:
        """Remove one advertiser of a name: it has withdrawn, or its proofs are no longer valid."""
        self._answered(name, now_s)
        self.cache.remove(name, advertiser)

    def receive_negative(self, name: Name, now_s: float, *, keep: bool = False) -> None:
        """Store that no node advertises a name, and drop the frames that wait for it.

        Args:
            keep: known locations take precedence over this response of a RIB that has just started.
        """
        self._answered(name, now_s)
        if not (keep and self.cache.of(name, now_s)):
            self.cache.put_negative(name, now_s)
            self.pending.drop(name, DropReason.NO_ROUTE)

    def receive_unknown(self, name: Name, rib: Name, now_s: float, others: AbstractSet[Name]) -> None:
        """Keep the locations of a name that a RIB does not know, and query the other RIBs, one after the other.

        Where none is left, the query is sent again at its next time.
        """
        self.cache.extend(name, now_s)
        if (query := self._queries.get(name)) is None:
            return
        query.passed_over.add(rib)
        if not others <= query.passed_over:
            self.requests.hasten(name, now_s)
        elif query.is_needed(now_s):
            self._answered(name, now_s)
        else:
            query.passed_over.clear()

    def _answered(self, name: Name, now_s: float, lease_s: float = NEVER_S) -> None:
        """Close the query for a name, or schedule the renewal of its watch; ``lease_s``: of the location in the answer.

        A RIB sends no location that only extends a lease, so the renewal comes before the lease ends.
        """
        if (query := self._queries.get(name)) is None:
            return
        query.passed_over.clear()
        if not query.is_needed(now_s):
            self._remove(name)
            return
        self._in_flight.discard(name)
        again_s = now_s + max(min(self._renewals(query).most_s, lease_s / 2), RETRY_S)
        self.requests.answered(name, again_s)
        self.requests.hasten(name, again_s)  # of several locations, and of one that was not asked for

    # -- time, and the RIB

    def queries_to_send(self, now_s: float) -> list[NameQuery]:
        """Return at most ``BATCH_MAX`` queries to send now; drop the frames of names that failed."""
        queries: list[NameQuery] = []
        for name in self.requests.poll_due(now_s, BATCH_MAX):
            query, is_open = self._queries[name], self.requests.is_open(name)
            if query.is_needed(now_s) or (is_open and self.requests.tries(name) < TRIES_MAX):
                queries.append(self._sent(query, now_s))
                continue
            self._remove(name)
            if is_open:
                self.pending.drop(name, DropReason.NO_ROUTE)
        while len(queries) < BATCH_MAX and self._is_window_ready():
            name = self._new.pop()
            query = self._queries[name]
            if now_s >= query.since_s + PENDING_S:  # the frame that needs it has expired
                self._remove(name)
                self.pending.drop(name, DropReason.NO_ROUTE)
                continue
            self._in_flight.add(name)
            queries.append(self._sent(query, now_s))
        return queries

    def next_query(self) -> float | None:
        """Return a monotonic second that is no later than the next query, or None."""
        return -NEVER_S if self._is_window_ready() else self.requests.next_due()

    def rib_changed(self, now_s: float, *, has_rib: bool) -> None:
        """Send every query again at once; without a RIB, serve entries beyond their leases."""
        self.cache.serve_stale(not has_rib, now_s)
        self.requests.start_all(now_s)

    def expire(self, now_s: float) -> list[Location]:
        """Drop the frames that waited too long and the entries whose leases ended; return the locations among them."""
        self.pending.expire(now_s)
        return self.cache.expire(now_s)

    def next_expiry(self) -> float | None:
        """Return a monotonic second that is no later than the next expiry, or None."""
        return earliest(self.pending.next_expiry(), self.cache.next_expiry())

    def _is_window_ready(self) -> bool:
        """Return whether a new name waits and the window has space for it."""
        return bool(self._new) and len(self._in_flight) < WINDOW

    def _sent(self, query: NameQuery, now_s: float) -> NameQuery:
        """Record one try of a query."""
        backoff = _QUERIES if self.requests.is_open(query.name) else self._renewals(query)
        self.requests.sent(query.name, now_s, backoff)
        query.sent_s, use_s = now_s, 2 * self._watch_s if query.used_until_s > now_s else 0.0
        query.watch_s = self._watch_s if query.is_watch else use_s
        return query

    def _renewals(self, query: NameQuery) -> Backoff:
        """Return the pauses of a watch: those of its repetitions, up to the time after which it is renewed."""
        return self._watch_renewals if query.is_watch else self._use_renewals

    def _add(self, name: Name, since_s: float, at_s: float, owner: bytes = b"") -> NameQuery:
        query = self._queries[name] = NameQuery(name=name, since_s=since_s, owner=owner)
        self.requests.start(name, at_s)
        return query

    def _remove(self, name: Name) -> None:
        self._new.discard(self._queries.pop(name).owner, name)
        self._in_flight.discard(name)
        self.requests.cancel(name)


class _PendingFrame(NamedTuple):
    frame: bytes
    until_s: float
    owner: bytes


class PendingFrames:
    """Frames by the name whose location they wait for; each that does not fit is counted.

    They are bounded in frames, bytes and time, and shared among the neighbours that sent them.
    """

    def __init__(self) -> None:
        self._by_name: OrderedDict[bytes, deque[_PendingFrame]] = OrderedDict()
        self._frames = Shares(PENDING_FRAMES_MAX)
        self._bytes = Shares(PENDING_BYTES_MAX)
        self.drops: Counter[DropReason] = Counter()

    def __len__(self) -> int:
        return len(self._frames)

    def park(
        self, name: bytes, frame: bytes, now_s: float, until_s: float | None = None, *, owner: bytes = b""
    ) -> None:
        """Store a frame until ``release``, or until ``until_s``; default: for ``PENDING_S``.

        Args:
            owner: the neighbour that it came from.
        """
        if not self._frames.reserve(owner):
            self.drops[DropReason.PENDING_FULL] += 1
            return
        if not self._bytes.reserve(owner, size=len(frame)):
            self._frames.release(owner)
            self.drops[DropReason.PENDING_FULL] += 1
            return
        waiting = _PendingFrame(frame, now_s + PENDING_S if until_s is None else until_s, owner)
        self._by_name.setdefault(name, deque()).append(waiting)

    def release(self, name: bytes) -> list[_PendingFrame]:
        """Remove and return, in order, the frames that wait for a name."""
        waiting = list(self._by_name.pop(name, ()))
        for each in waiting:
            self._give_back(each)
        return waiting

    def _give_back(self, waiting: _PendingFrame) -> None:
        self._frames.release(waiting.owner)
        self._bytes.release(waiting.owner, size=len(waiting.frame))

    def drop(self, name: bytes, reason: DropReason) -> None:
        """Drop the frames that wait for a name, under a reason."""
        self.drops[reason] += len(self.release(name))

    def expire(self, now_s: float) -> None:
        """Drop the frames that waited too long."""
        for name in list(self._by_name):
            waiting = self._by_name[name]
            while waiting and waiting[0].until_s <= now_s:
                self._give_back(waiting.popleft())
                self.drops[DropReason.PENDING_EXPIRED] += 1
            if not waiting:
                del self._by_name[name]

    def next_expiry(self) -> float | None:
        """Return the monotonic second at which the first frame has waited long enough, or None."""
        return min((waiting[0].until_s for waiting in self._by_name.values()), default=None)
