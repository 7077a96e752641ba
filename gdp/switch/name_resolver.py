"""Name resolution at a switch: the name cache, the pending frames, and the queries to the RIB.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). It works like the neighbour cache of RFC 4861, sections 5.1
and 7.2.2: a miss makes one query and keeps the frame; the response releases the frame, or its end drops it::

    frame without an entry (core.py)
      -> Unicast.miss -> resolve: a location, or a negative entry -> table entry, and the frame goes on
                      `-> resolve: unknown                        -> a query is open: buffer_frame
    timer of the core -> RibClient.send_due -> queries_to_send       -> query to the RIB, repeated until a response
    response of a RIB -> RibClient.receive -> LocationUpdates.receive -> receive_location -> Unicast.release: the frame
                                           |-> receive_negative      -> the frame is dropped, counted
                                           `-> receive_unknown       -> known locations stay; the next RIB is queried
    timer of the core -> expire: leases, negative entries and pending frames end
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Set as AbstractSet
from typing import Final, NamedTuple

from gdp.control.neighbour import Neighbour
from gdp.due_queue import earliest
from gdp.errors import DropReason
from gdp.intervals import ADVERTISEMENT
from gdp.limits import QUESTIONS_RATE, SWITCH_QUESTIONS_RATE
from gdp.names import Name
from gdp.switch.name_cache import Location, NameCache
from gdp.switch.name_queries import NameQueries
from gdp.switch.pending_frames import PendingFrames
from gdp.token_bucket import TokenBuckets
from gdp.trust.right import Right

__all__ = ["NameResolver", "Resolution"]

_FROM_NODE: Final = b"n"  # begins an owner
_FROM_SWITCH: Final = b"s"
_ACCEPTS_FRAMES: Final = (Right.ATTACH, Right.SERVE)


class Resolution(NamedTuple):
    """The known locations of a name.

    Attributes:
        locations: where its advertisers are.
        reason: why ``locations`` is empty; None where it is not.
    """

    locations: list[Location]
    reason: DropReason | None = None


class NameResolver:
    """Resolves the names of one switch.

    Args:
        me: this switch.
        lease_s: seconds for which the RIB keeps a watch; see ``NameQueries``.

    Attributes:
        cache: the locations that are known.
        queries: to the RIB; readers attached here watch names by them.
        pending: frames that wait for a response.
    """

    def __init__(self, me: Name, lease_s: float = ADVERTISEMENT.lease_s) -> None:
        self._me = me
        self.cache = NameCache(lease_s)
        self.queries = NameQueries(lease_s)
        self.pending = PendingFrames()
        self._rates = {
            _FROM_NODE: TokenBuckets(*QUESTIONS_RATE),
            _FROM_SWITCH: TokenBuckets(*SWITCH_QUESTIONS_RATE),
        }
        self._refused: Counter[DropReason] = Counter()

    @property
    def drops(self) -> Counter[DropReason]:
        """Return how many frames were dropped instead of being released, by reason."""
        return self._refused + self.pending.drops

    @staticmethod
    def owner_of(neighbour: Neighbour) -> bytes:
        """Return the owner of the queries and pending frames that a neighbour causes."""
        return (_FROM_SWITCH if neighbour.role.is_switch else _FROM_NODE) + neighbour.name

    # -- resolve

    def resolve(self, name: Name, now_s: float, owner: bytes = b"") -> Resolution | None:
        """Return where frames to a name go, or None after a query to the RIB.

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
            self.queries.use(name, now_s)
            return Resolution(elsewhere)
        if accepting or not (known or self.cache.is_negative(name, now_s)):  # it has left this switch, or is unknown
            self._request(name, now_s, owner)
            return None
        return Resolution([], DropReason.NO_READER if known else DropReason.NO_ROUTE)

    def resolve_source(self, name: Name, now_s: float, owner: bytes = b"") -> Resolution | None:
        """Return where the source of frames is attached, whatever its rights, or None after a query to the RIB.

        Args:
            owner: as in ``resolve``.
        """
        known = self.cache.of(name, now_s)
        if known:
            self.queries.use(name, now_s)
            return Resolution(known)
        if self.cache.is_negative(name, now_s):
            return Resolution([], DropReason.NO_ROUTE)
        self._request(name, now_s, owner)
        return None

    def find(self, name: Name, now_s: float) -> list[Location] | None:
        """Return every known advertiser of a name, whatever its right, or None after a query to the RIB."""
        found = self.resolve_source(name, now_s)
        return None if found is None else found.locations

    def _request(self, name: Name, now_s: float, owner: bytes) -> None:
        """Open a query within the rate of its owner."""
        rate = self._rates.get(owner[:1])
        if rate is None or name in self.queries or rate.spend(owner, now_s):
            self.queries.request(name, now_s, owner)

    # -- pending frames

    def buffer_frame(self, name: Name, frame: bytes, now_s: float, owner: bytes, until_s: float | None = None) -> None:
        """Buffer a frame until the response for its name, or until ``until_s`` (default: for ``PENDING_S``).

        The frame is dropped where no query for the name is open, too many are, or its owner exceeds its rate.
        """
        if name in self.queries:
            self.pending.park(name, frame, now_s, until_s, owner=owner)
        else:
            self._refused[DropReason.PENDING_FULL] += 1

    # -- receive a response

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
        if not has_left and (not is_ours or is_repeated):
            self.queries.receive_answer(location.name, now_s)

    def receive_removal(self, name: Name, advertiser: Name, now_s: float) -> None:
        """Remove one advertiser of a name: it has withdrawn, or its proofs are no longer valid."""
        self.queries.receive_answer(name, now_s)
        self.cache.remove(name, advertiser)

    def receive_negative(self, name: Name, now_s: float, *, keep: bool = False) -> None:
        """Store that no node advertises a name, and drop the frames that wait for it.

        Args:
            keep: known locations take precedence over this response of a RIB that has just started.
        """
        self.queries.receive_answer(name, now_s)
        if not (keep and self.cache.of(name, now_s)):
            self.cache.put_negative(name, now_s)
            self.pending.drop(name, DropReason.NO_ROUTE)

    def receive_unknown(self, name: Name, rib: Name, now_s: float, others: AbstractSet[Name]) -> None:
        """Keep the locations of a name that a RIB does not know, and query the other RIBs, one after the other."""
        self.cache.extend(name, now_s)
        self.queries.receive_unknown(name, rib, now_s, others)

    # -- time and the RIB

    def queries_to_send(self, now_s: float) -> list[tuple[Name, float]]:
        """Return the queries that are due, as (name, seconds to watch it); drop the frames of names that failed."""
        queries, failed = self.queries.poll_due(now_s)
        for name in failed:
            self.pending.drop(name, DropReason.NO_ROUTE)
        return queries

    def rib_changed(self, now_s: float, *, has_rib: bool) -> None:
        """Send every query again at once; without a RIB, serve entries beyond their leases."""
        self.cache.serve_stale(not has_rib, now_s)
        self.queries.repeat_all(now_s)

    def expire(self, now_s: float) -> list[Location]:
        """Drop the frames that waited too long and the entries whose leases ended; return the locations among them."""
        self.pending.expire(now_s)
        return self.cache.expire(now_s)

    def next_expiry(self) -> float | None:
        """Return a monotonic second that is no later than the next expiry, or None."""
        return earliest(self.pending.next_expiry(), self.cache.next_expiry())
