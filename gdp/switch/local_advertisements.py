"""Local advertisements: what attached nodes advertise through this switch, and whether the RIB has acknowledged it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final, TypeAlias

from gdp.due_queue import DueQueue, earliest
from gdp.errors import DropReason, StatementError
from gdp.limits import ATTACHED_MAX
from gdp.message.shares import Shares
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import Right

# many attempts in a lease, for a relay over a lossy path often fails; fewer over a slow link
_RELAYS: Final = Backoff(0.4, 3.2)
_ROUND_TRIPS: Final = 2.0
RELAY_TRIES: Final = 20
_DEPARTED_S: Final = 30.0  # how long it is known that a node was attached here
_DEPARTED_MAX: Final = 4_096
_Key: TypeAlias = tuple[Name, Name]  # name, advertiser


@dataclass(slots=True, kw_only=True)
class LocalAdvertisement:
    """One advertisement of one attached node."""

    advertisement: Advertisement
    port: int
    mac: bytes
    expires_s: float
    is_slow: bool = False  # it was last relayed over a slow link
    is_settled: bool = False  # the RIB has sent an AdvertiseAck


class LocalAdvertisements:
    """The advertisements of all attached nodes, by (name, advertiser); bounded, and shared among the nodes."""

    def __init__(self) -> None:
        self._by_name: dict[Name, dict[Name, LocalAdvertisement]] = {}
        self._shares = Shares(ATTACHED_MAX)
        self._relays = Requests[_Key]()
        self._ends = DueQueue[_Key]()
        self._departed: OrderedDict[_Key, float] = OrderedDict()  # until when it is remembered

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
            advertisement=advertisement, port=port, mac=mac, expires_s=now_s + advertisement.lease_s
        )
        key, relay_at_s = (advertisement.name, advertisement.node), now_s
        before = self.get(advertisement.name, advertisement.node)
        if before is not None and before.is_slow and not before.is_settled and (before.port, before.mac) == (port, mac):
            relay_at_s, attachment.is_slow = max(self._relays.due_s(key, now_s), now_s), True
        self._by_name.setdefault(advertisement.name, {})[advertisement.node] = attachment
        self._relays.start(key, relay_at_s)
        self._ends.put(key, attachment.expires_s)
        return attachment

    def remove(self, name: Name, advertiser: Name) -> LocalAdvertisement | None:
        """Remove an advertisement and return it, or None."""
        advertisements = self._by_name.get(name, {})
        gone = advertisements.pop(advertiser, None)
        self._relays.cancel((name, advertiser))
        self._ends.discard((name, advertiser))
        if gone is not None:
            self._shares.release(advertiser)
        if not advertisements:
            self._by_name.pop(name, None)
        return gone

    def depart(self, name: Name, advertiser: Name, now_s: float) -> None:
        """Remove an advertisement of a node that is not attached here any more, and remember that it was."""
        self.remove(name, advertiser)
        self._departed[name, advertiser] = now_s + _DEPARTED_S
        self._departed.move_to_end((name, advertiser))
        if len(self._departed) > _DEPARTED_MAX:
            self._departed.popitem(last=False)

    def was_here(self, name: Name, advertiser: Name, now_s: float) -> bool:
        """Return whether an advertiser of a name departed recently."""
        return self._departed.get((name, advertiser), 0.0) > now_s

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
        self._relays.cancel((name, advertiser))
        return attachment

    def relay_all(self, now_s: float) -> None:
        """Make every advertisement due to be relayed: there is a new RIB."""
        for attachment in self.all():
            attachment.is_settled = False
            self._relays.start((attachment.advertisement.name, attachment.advertisement.node), now_s)

    def is_relay_due(self, now_s: float) -> bool:
        """Return whether an advertisement is to be relayed now."""
        due_s = self._relays.next_due()
        return due_s is not None and due_s <= now_s

    def due(self, now_s: float, trip_s: float) -> list[LocalAdvertisement]:
        """Return the advertisements to relay now.

        Args:
            trip_s: round trip of the link towards the RIB; relays do not fill a slow one.
        """
        interval_s = _RELAYS.pause_s(1, _ROUND_TRIPS * trip_s)
        # behind a slow link the relays of all names are a queue of their own, for which the next ones must not count
        repeats, due = Backoff(interval_s, interval_s if interval_s == _RELAYS.first_s else _RELAYS.most_s), []
        for key in self._relays.poll_due(now_s):
            name, advertiser = key
            each = self._by_name[name][advertiser]
            each.is_slow = interval_s > _RELAYS.first_s
            self._relays.sent(key, now_s, repeats)
            if self._relays.tries(key) == RELAY_TRIES:
                self._relays.cancel(key)
            due.append(each)
        return due

    def expire(self, now_s: float) -> list[LocalAdvertisement]:
        """Remove and return the advertisements that were not renewed."""
        gone = [self.remove(name, advertiser) for name, advertiser in self._ends.poll_due(now_s)]
        return [each for each in gone if each is not None]

    def next_event(self) -> float | None:
        """Return the monotonic second of the next relay or lease end, or None."""
        return earliest(self._relays.next_due(), self._ends.next_due())

    def next_expiry(self) -> float | None:
        """Return the monotonic second of the next lease end, or None."""
        return self._ends.next_due()
