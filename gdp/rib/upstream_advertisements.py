"""Advertisements for the tier above: each is repeated until one of its RIBs has acknowledged it.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Of several RIBs above one is used; where it does not respond,
the next one is, until a preferred one responds again. While none responds, pending advertisements are kept to the end
of their leases, within a bound.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from gdp.control.rib_replication import Key
from gdp.intervals import RETRY_S
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.rib.route import Route

_REPEATS: Final = Backoff(0.3, 5.0)
# without an answer to a probe for this and three round trips, at most PROBE_S, the next RIB above replaces this one
SILENT_MIN_S: Final = 0.12
PROBE_S: Final = 1.0  # with several RIBs above, the one in use receives a query or a probe at least this often
QUIET_S: Final = 2 * PROBE_S  # a RIB above may wait itself for the tier above it
SEND_MAX: Final = 256  # at once, so that AdvertiseAcks are received in between
WAITING_MAX: Final = 65_536


class Passed(NamedTuple):
    """An advertisement or a withdrawal of a route, for the tier above, until the lease of the route ends."""

    route: Route
    sequence: int
    statement: bytes


class UpstreamAdvertisements:
    """The tier above as one RIB sees it; ``ribs``: of the tier above, the preferred one first; empty at the top."""

    def __init__(self, ribs: tuple[Name, ...]) -> None:
        self._ribs = ribs
        self._at = 0
        self._waiting: dict[Key, Passed] = {}
        self._requests = Requests[Key](is_sorted=True)
        self._asked_s: float | None = None  # since when a message is unanswered
        self._unheard_s: float | None = None  # when the first message left since one of them was heard
        self._heard_s = float("-inf")
        self._return_at_s = float("inf")  # when to probe the preferred RIBs
        self._probed_s: float | None = None  # when they were probed last, since another one is in use
        self._round_trip_s = 0.0  # smoothed, as in RFC 6298

    @property
    def rib(self) -> Name | None:
        """Return the RIB above that is in use, or None at the top."""
        return self._ribs[self._at] if self._ribs else None

    def has(self, name: Name) -> bool:
        """Return whether this is a RIB of the tier above."""
        return name in self._ribs

    def put(self, passed: Passed, now_s: float) -> None:
        """Send an advertisement upstream until it is acknowledged; it replaces the same advertiser's pending one."""
        key = passed.route.key
        if key not in self._waiting and len(self._waiting) >= WAITING_MAX:
            self.remove(next(iter(self._waiting)))
        self._waiting[key] = passed
        self._requests.start(key, now_s)

    def handle_ack(self, key: Key, sequence: int) -> None:
        """Record an AdvertiseAck for a sequence number, or for an older advertisement than one stored above."""
        waiting = self._waiting.get(key)
        if waiting is not None and sequence >= waiting.sequence:
            self.remove(key)

    def remove(self, key: Key) -> None:
        """Drop an advertiser's pending advertisement: it was acknowledged or rejected, or its lease ended."""
        self._waiting.pop(key, None)
        self._requests.cancel(key)

    def probe(self, now_s: float, quiet_s: float) -> bool:
        """Return whether to probe the RIB in use, if it is one of several and silent for ``quiet_s``."""
        if len(self._ribs) < 2 or self._asked_s is not None or now_s - self._heard_s < quiet_s:
            return False
        self._asked_s = now_s
        return True

    def preferred(self, now_s: float) -> tuple[Name, ...]:
        """Return the RIBs to probe now, because they are preferred to the one in use."""
        if now_s < self._return_at_s:
            return ()
        self._probed_s, self._return_at_s = now_s, now_s + RETRY_S
        return self._ribs[: self._at]

    def record_alive(self, rib: Name, now_s: float) -> bool:
        """Record a sign of life of a RIB above; return whether all queries are to be sent again.

        That is after a silence, and where another RIB is used from now on: one that is preferred and was probed. A late
        response to an earlier query does not count. All pending advertisements are due then, too.
        """
        was_silent, self._unheard_s = self.is_silent(now_s), None
        if self._probed_s is not None and rib in self._ribs[: self._at]:
            self._round_trip_s += (now_s - self._probed_s - self._round_trip_s) / 8
            self._use(self._ribs.index(rib), now_s)
            return True
        if rib != self.rib:
            return was_silent
        if self._asked_s is not None:
            if self._is_gone(now_s):
                self._requests.start_all(now_s)
            self._round_trip_s += (now_s - self._asked_s - self._round_trip_s) / 8
        self._asked_s, self._heard_s = None, now_s
        return was_silent

    def record_asked(self, now_s: float) -> None:
        """Record that something was sent to the tier above, to which it responds."""
        if self._unheard_s is None:
            self._unheard_s = now_s

    def is_silent(self, now_s: float) -> bool:
        """Return whether no RIB of the tier above has responded for ``QUIET_S``, though it should have."""
        return self._unheard_s is not None and now_s - self._unheard_s >= QUIET_S

    def turn_over(self, now_s: float) -> bool:
        """Select the next RIB above if the one in use is silent; return whether that is so."""
        if len(self._ribs) < 2 or self._asked_s is None or now_s - self._asked_s < self._silent_s():
            return False
        self._use((self._at + 1) % len(self._ribs), now_s)
        return True

    def due(self, now_s: float) -> list[Passed]:
        """Return the advertisements to send to ``rib`` now; those with ended leases are dropped."""
        found: list[Passed] = []
        most = 1 if self._is_gone(now_s) else SEND_MAX
        while len(found) < SEND_MAX and (keys := self._requests.poll_due(now_s, 1)):
            waiting = self._waiting[keys[0]]
            if waiting.route.expires_s <= now_s:
                self.remove(keys[0])
                continue
            self._requests.sent(keys[0], now_s, _REPEATS)
            if len(found) < most:
                found.append(waiting)
        if found:
            self.record_asked(now_s)
            if self._asked_s is None:
                self._asked_s = now_s
        return found

    def next_due(self) -> float | None:
        """Return a monotonic second that is no later than the next timer, or None."""
        due_s = self._requests.next_due()
        times = [] if due_s is None else [due_s]
        if len(self._ribs) > 1:
            times.append(self._heard_s + PROBE_S if self._asked_s is None else self._asked_s + self._silent_s())
            times.append(self._return_at_s)
        return min(times, default=None)

    def _use(self, at: int, now_s: float) -> None:
        self._at, self._asked_s, self._probed_s = at, None, None
        self._return_at_s = now_s + RETRY_S if at else float("inf")
        self._requests.start_all(now_s)

    def _silent_s(self) -> float:
        return min(SILENT_MIN_S + 3 * self._round_trip_s, PROBE_S)

    def _is_gone(self, now_s: float) -> bool:
        return self._asked_s is not None and now_s - self._asked_s >= PROBE_S
