"""Local advertisements: what attached nodes advertise through this switch, and whether the RIB has acknowledged it.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Final

from gdp.errors import DropReason, StatementError
from gdp.limits import ATTACHED_MAX
from gdp.message.shares import Shares
from gdp.names import Name
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import Right

__all__ = ["LocalAdvertisement", "LocalAdvertisements"]

RELAY_AGAIN_S: Final = 0.4  # many attempts in a lease: a relay over a lossy path often fails
_RELAY_MAX_S: Final = 3.2  # over a slow link
_ROUND_TRIPS: Final = 2.0
RELAY_TRIES: Final = 20


@dataclass(slots=True, kw_only=True)
class LocalAdvertisement:
    """One advertisement of one attached node."""

    advertisement: Advertisement
    port: int
    mac: bytes
    expires_s: float
    relay_at_s: float
    tries: int = 0
    is_slow: bool = False  # it was last relayed over a slow link
    is_settled: bool = False  # the RIB has sent an AdvertiseAck


class LocalAdvertisements:
    """The advertisements of all attached nodes, by (name, advertiser); bounded, and shared among the nodes."""

    def __init__(self) -> None:
        self._by_name: dict[Name, dict[Name, LocalAdvertisement]] = {}
        self._shares = Shares(ATTACHED_MAX)
        self._relays: list[
            tuple[float, int, LocalAdvertisement]
        ] = []  # heaps; entries that a renewal made stale are skipped
        self._ends: list[tuple[float, int, LocalAdvertisement]] = []
        self._pushed = 0

    def __len__(self) -> int:
        return len(self._shares)

    def get(self, name: Name, advertiser: Name) -> LocalAdvertisement | None:
        """Return an advertisement, or None."""
        return self._by_name.get(name, {}).get(advertiser)

    def named(self, name: Name) -> list[LocalAdvertisement]:
        """Return the advertisements of one name."""
        return list(self._by_name.get(name, {}).values())

    def at(self, name: Name) -> LocalAdvertisement | None:
        """Return an advertisement that takes unicast frames for a name, or None."""
        for attachment in self._by_name.get(name, {}).values():
            if attachment.advertisement.right in (Right.ATTACH, Right.SERVE):
                return attachment
        return None

    def put(self, advertisement: Advertisement, port: int, mac: bytes, now_s: float) -> LocalAdvertisement:
        """Store a verified advertisement; it is due to be relayed at once.

        In place of one that waits behind a slow link it is relayed when that one was due: nodes repeat themselves, too.

        Raises:
            StatementError: QUOTA, the node has too many.
        """
        if self.get(advertisement.name, advertisement.node) is None and not self._shares.reserve(advertisement.node):
            raise StatementError(DropReason.QUOTA, "advertisements of one node")
        attachment = LocalAdvertisement(
            advertisement=advertisement, port=port, mac=mac, expires_s=now_s + advertisement.lease_s, relay_at_s=now_s
        )
        before = self.get(advertisement.name, advertisement.node)
        if before is not None and before.is_slow and not before.is_settled and (before.port, before.mac) == (port, mac):
            attachment.relay_at_s, attachment.is_slow = max(before.relay_at_s, now_s), True
        self._by_name.setdefault(advertisement.name, {})[advertisement.node] = attachment
        self._push(self._relays, attachment.relay_at_s, attachment)
        self._push(self._ends, attachment.expires_s, attachment)
        return attachment

    def remove(self, name: Name, advertiser: Name) -> LocalAdvertisement | None:
        """Remove an advertisement and return it, or None."""
        advertisements = self._by_name.get(name, {})
        gone = advertisements.pop(advertiser, None)
        if gone is not None:
            self._shares.release(advertiser)
        if not advertisements:
            self._by_name.pop(name, None)
        return gone

    def all(self) -> list[LocalAdvertisement]:
        """Return every advertisement."""
        return [each for advertisements in self._by_name.values() for each in advertisements.values()]

    def of(self, advertiser: Name) -> list[LocalAdvertisement]:
        """Return all advertisements of one node."""
        return [advertisements[advertiser] for advertisements in self._by_name.values() if advertiser in advertisements]

    def handle_ack(self, name: Name, advertiser: Name, taken: int | None) -> LocalAdvertisement | None:
        """Record the RIB's AdvertiseAck; return the advertisement.

        Args:
            taken: the sequence number that the RIB accepted, if it did; it does not settle a newer advertisement.
        """
        attachment = self.get(name, advertiser)
        if attachment is None or (taken is not None and taken < attachment.advertisement.sequence):
            return None
        attachment.is_settled = True
        return attachment

    def relay_all(self, now_s: float) -> None:
        """Make every advertisement due to be relayed: there is a new RIB."""
        for attachment in self.all():
            attachment.is_settled, attachment.relay_at_s, attachment.tries = False, now_s, 0
            self._push(self._relays, now_s, attachment)

    def is_relay_due(self, now_s: float) -> bool:
        """Return whether an advertisement is to be relayed now."""
        return self._next_relay() <= now_s

    def due(self, now_s: float, trip_s: float) -> list[LocalAdvertisement]:
        """Return the advertisements to relay now.

        Args:
            trip_s: round trip of the link towards the RIB; relays do not fill a slow one.
        """
        due, interval_s = [], min(max(RELAY_AGAIN_S, _ROUND_TRIPS * trip_s), _RELAY_MAX_S)
        while self._next_relay() <= now_s:
            each = heapq.heappop(self._relays)[2]
            each.tries += 1
            each.relay_at_s, each.is_slow = now_s + interval_s, interval_s > RELAY_AGAIN_S
            self._push(self._relays, each.relay_at_s, each)
            due.append(each)
        return due

    def expire(self, now_s: float) -> list[LocalAdvertisement]:
        """Remove and return the advertisements that were not renewed."""
        late = []
        while self._next_end() <= now_s:
            late.append(heapq.heappop(self._ends)[2])
            self.remove(late[-1].advertisement.name, late[-1].advertisement.node)
        return late

    def next_event(self) -> float | None:
        """Return the monotonic second of the next relay or lease end, or None."""
        next_s = min(self._next_relay(), self._next_end())
        return None if next_s == float("inf") else next_s

    def next_expiry(self) -> float | None:
        """Return the monotonic second of the next lease end, or None."""
        next_s = self._next_end()
        return None if next_s == float("inf") else next_s

    def _push(
        self, heap: list[tuple[float, int, LocalAdvertisement]], at_s: float, attachment: LocalAdvertisement
    ) -> None:
        self._pushed += 1
        heapq.heappush(heap, (at_s, self._pushed, attachment))

    def _is_held(self, attachment: LocalAdvertisement) -> bool:
        return self.get(attachment.advertisement.name, attachment.advertisement.node) is attachment

    def _next_relay(self) -> float:
        while self._relays:
            at_s, _, each = self._relays[0]
            is_open = not each.is_settled and each.tries < RELAY_TRIES
            if is_open and each.relay_at_s == at_s and self._is_held(each):
                return at_s
            heapq.heappop(self._relays)
        return float("inf")

    def _next_end(self) -> float:
        while self._ends:
            at_s, _, each = self._ends[0]
            if self._is_held(each):
                return at_s
            heapq.heappop(self._ends)
        return float("inf")
