"""Outbox of a RIB: it signs statements, and decides which members receive a route, its move or its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from gdp.control.rib_replication import Key
from gdp.control.rib_statements import AdvertiseAck, Response
from gdp.crypto.identity import Identity
from gdp.crypto.schema import Body
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.intervals import LEASE_MIN_S, NEGATIVE_LEASE_S
from gdp.names import Name
from gdp.rib.route import Route, Withdrawn
from gdp.rib.store import Store
from gdp.rib.watches import WATCHED_S, Asker, Watches
from gdp.trust.domain import Policy


class OutgoingStatement(NamedTuple):
    """A statement to send to a name."""

    to: Name
    kind: Kind
    statement: bytes
    about: Key | None = None  # the stored entry that it reports: not sent if the store did not accept that


class RibOutbox:
    """Statements to send.

    Args:
        watches: how many watches there may be, and as many holders.

    Attributes:
        watches: members that are notified of every change of a name.
        holders: members that received a response, for its lease.
    """

    def __init__(self, identity: Identity, policy: Policy, store: Store, watches: int) -> None:
        self._identity = identity
        self._policy = policy
        self._store = store
        self._outgoing: list[OutgoingStatement] = []
        self.watches = Watches(watches)
        self.holders = Watches(watches)
        self.answers = 0
        self.negative_answers = 0
        self.unknown_answers = 0

    def send_body(self, kind: Kind, body: Body, *to: Name, about: Key | None = None) -> None:
        """Sign a body once, and send it to each of the names; ``about``: as of ``OutgoingStatement``."""
        if to:
            wire = self._identity.signed(body)
            self._outgoing += [OutgoingStatement(name, kind, wire, about) for name in to]

    def poll_statements(self) -> list[OutgoingStatement]:
        """Return, once, the statements to send; those about changes that the store did not accept are left out."""
        refused = set(self._store.commit())
        outgoing, self._outgoing = self._outgoing, []
        return [each for each in outgoing if each.about not in refused]

    def may_receive(self, route: Route, asker: Asker) -> bool:
        """Return whether an asker may receive a route.

        A local name stays in its domain. A RIB below does not receive what its own domain advertised.
        """
        if asker.domain == self._policy.own:
            return True
        return route.is_global and not (asker.is_rib and asker.domain in (route.domain, route.via))

    def send_route(self, route: Route, to: Asker, now_s: float) -> None:
        """Send a route to a member that may receive it, and that holds it for the lease."""
        if not self.may_receive(route, to):
            return
        lease_s = min(max(route.expires_s - now_s, 0.0), WATCHED_S)
        try:
            self.holders.add(route.name, to, now_s + lease_s)
        except StatementError:
            lease_s = min(lease_s, LEASE_MIN_S)
        response = Response(
            name=route.name,
            advertiser=route.advertiser,
            advertisement=route.advertisement,
            domain=route.domain,
            transit=route.transit,
            lease_s=lease_s,
        )
        self.answers += 1
        self.send_body(Kind.RIB_ANSWER, response, to.name, about=route.key)

    def send_none(self, name: Name, to: Name, *, is_unknown: bool = False) -> None:
        """Answer that no node advertises a name, or, if the tier above could not be asked, that it is not known."""
        self.unknown_answers += is_unknown
        self.negative_answers += not is_unknown
        response = Response(
            name=name,
            advertiser=name,
            advertisement=b"",
            domain=self._policy.own,
            transit=(),
            lease_s=0.0 if is_unknown else NEGATIVE_LEASE_S,
        )
        self.send_body(Kind.RIB_ANSWER, response, to)

    def send_ack(self, key: Key, refused: DropReason | None, sequence: int, to: Name) -> None:
        """Tell a relay that an advertisement or a withdrawal is stored, or why not."""
        self.send_body(
            Kind.RIB_ANSWER, AdvertiseAck(*key, refused, sequence), to, about=key if refused is None else None
        )

    def notify(self, route: Route, known: Route | Withdrawn | None, now_s: float, askers: Sequence[Asker] = ()) -> None:
        """Send a route to ``askers``, to watchers, and after a move to holders and the sender of the old location."""
        recipients = dict.fromkeys((*askers, *self.watches.watchers(route.name, now_s)))
        if isinstance(known, Route) and known.place != route.place:
            recipients |= dict.fromkeys(self.holders.watchers(route.name, now_s))
            if known.sender != route.sender:
                recipients |= self._relay_of(known)
        for asker in recipients:
            self.send_route(route, asker, now_s)

    def notify_gone(self, route: Route, now_s: float, by: Name | None = None) -> None:
        """Notify a name's watchers, holders and sender that a route is gone, except ``by``, which knows."""
        recipients = self.interested_in(route.name, now_s)
        if by not in (None, route.sender):
            recipients |= self._relay_of(route)
        gone = Response(
            name=route.name,
            advertiser=route.advertiser,
            advertisement=b"",
            domain=route.domain,
            transit=(),
            lease_s=0.0,
            sequence=route.sequence,
        )
        to = [asker.name for asker in recipients if self.may_receive(route, asker)]
        self.send_body(Kind.RIB_ANSWER, gone, *to)

    def interested_in(self, name: Name, now_s: float) -> dict[Asker, None]:
        """Return the members that watch or hold a name."""
        return dict.fromkeys((*self.watches.watchers(name, now_s), *self.holders.watchers(name, now_s)))

    def concerned_by(self, name: Name, now_s: float) -> dict[Asker, None]:
        """Return the nodes that advertised, hold or watch a name."""
        recipients = self.interested_in(name, now_s)
        for route in self._store.routes(name):
            recipients |= self._relay_of(route)
        return recipients

    @staticmethod
    def _relay_of(route: Route) -> dict[Asker, None]:
        """Return the relay of a route, unless that was the tier above."""
        is_rib = route.sender != route.switch
        return {} if route.is_from_upstream else {Asker(route.sender, route.via, is_rib): None}
