"""RIB client of a switch: it relays advertisements, sends queries, and verifies the responses.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

Queries go to the nearest RIB of the switch's own domain, over other domains where its own is partitioned. Where the own
domain has none, they go to RIBs of domains through which traffic may pass: for a known name to the RIB that gave its
location, or one of the advertiser's domain; else to the nearest, and to the next one if that does not know. RIBs at the
same distance are ordered by a hash that differs for each switch, so that no name is preferred. A RIB that owes a
response for ``SILENT_S`` is replaced by the next one.

While no RIB responds, known locations are still served (``name_resolver.py``). They are also kept where a RIB responds
that it does not know, or denies a name that it could not know. The name resolver decides which queries are due;
``location_updates.py`` applies the responses.
"""

from __future__ import annotations

import hashlib
from typing import Final

from gdp.control.channel import Channels, Opened
from gdp.control.link_state import AttachedRib
from gdp.control.presence import Presence
from gdp.control.rib_statements import AdvertiseAck, Query, RelayedStatement, Response, relayed
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.schema import CERTIFICATE
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.due_queue import earliest
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage
from gdp.frame.codec import Kind
from gdp.intervals import REFUSED_S
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.switch.endpoint_exchange import EndpointExchange
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.location_updates import LocationUpdates
from gdp.switch.name_resolver import NameQuery
from gdp.switch.presence import PresenceAnswers
from gdp.switch.relocation import Relocations
from gdp.switch.unicast import Unicast

SILENT_S: Final = 1.6  # longer than a RIB waits for the tier above
_REFILL_S: Final = 10.0  # how long negative responses of a RIB that is new here do not override known locations


class RibClient:
    """Exchanges statements with the nearest RIB.

    Attributes:
        endpoints: exchange of endpoint records with it.
        presence: answers to questions of RIBs about attached nodes.
        rib: the RIB in use, or None while none is known.
    """

    def __init__(
        self,
        state: ForwardingState,
        channels: Channels,
        unicast: Unicast,
        relocations: Relocations,
        locations: LocationUpdates,
    ) -> None:
        self._state = state
        self._channels = channels
        self._unicast = unicast
        self._relocations = relocations
        self._locations = locations
        self.presence = PresenceAnswers(state, unicast)
        self.endpoints = EndpointExchange(state.identity, state.policy)
        self.rib: Name | None = None
        self._session = b""  # of that RIB with its switch: another one means that it restarted or moved
        self._chosen_s = float("-inf")
        self._others: tuple[AttachedRib, ...] = ()  # where the own domain has no RIB: those in reach, the nearest first
        self._owed: dict[Name, float] = {}  # RIBs that owe a response, since when
        self._avoided: dict[Name, float] = {}  # RIBs that did not respond, until when
        self._review_s = float("inf")  # when one of them may be used again
        self._asked: dict[Name, None] = {}  # RIBs whose responses are accepted, the newest last

    def links_changed(self, now_s: float) -> None:
        """Select the RIB again; a new one receives all advertisements and queries."""
        reached = self._reached(now_s)
        rib = reached[0].name if reached else None
        self._others = tuple(reached) if reached and reached[0].domain != self._state.policy.own else ()
        known = None if rib is None else self._state.paths.ribs().get(rib)
        session = b"" if known is None else known.session
        if (rib, session) != (self.rib, self._session):
            self.rib, self._session, self._chosen_s = rib, session, now_s
            self._owed.clear()
            if rib is not None:
                self._channels.renew(rib)
            self._state.attached.relay_all(now_s)
            self._state.resolver.rib_changed(now_s, has_rib=rib is not None)
            self.endpoints.rib_changed(now_s)
        self.send_due(now_s)

    def _reached(self, now_s: float) -> list[AttachedRib]:
        """Return the RIBs in reach, the one to use first."""
        own, transit, me = self._state.policy.own, self._state.policy.transit, self._state.me
        reached: list[tuple[bool, bool, int, bytes, AttachedRib]] = []
        for name, rib in self._state.paths.ribs().items():
            if rib.domain not in transit:
                continue
            way, host = self._state.paths.to_rib(name, transit)
            if host is not None:
                is_avoided = self._avoided.get(name, 0.0) > now_s
                distance, spread = 0 if way is None else way.distance, hashlib.sha256(me + name).digest()
                reached.append((is_avoided, rib.domain != own, distance, spread, rib))
        return [each[-1] for each in sorted(reached)]

    def _rib_for(self, query: NameQuery, now_s: float) -> Name | None:
        """Return the RIB to send a query to."""
        if not self._others:
            return self.rib
        left = [rib for rib in self._others if rib.name not in query.passed_over] or self._others
        known = self._state.resolver.cache.of(query.name, now_s)
        sources, domains = {place.source[0] for place in known if place.source}, {place.domain for place in known}
        avoided = {rib for rib, until_s in self._avoided.items() if until_s > now_s}
        return min(left, key=lambda rib: (rib.name in avoided, rib.name not in sources, rib.domain not in domains)).name

    def send_due(self, now_s: float) -> None:
        """Send the relays and queries that are due."""
        self._channels.handle_timer(now_s)
        self._send(now_s)
        if self.rib is None:
            return
        if now_s >= self._review_s:
            self._review_s = float("inf")
            self.links_changed(now_s)
        for rib in [rib for rib, since_s in self._owed.items() if now_s - since_s >= SILENT_S]:
            self._leave_silent_rib(rib, now_s)
        if self._state.attached.is_relay_due(now_s):
            for attachment in self._state.attached.due(now_s, self._trip_s(self.rib)):
                self.relay(attachment.advertisement.wire, now_s)
        for statement in self.endpoints.statements_to_send(now_s):
            self._to_rib(statement, now_s)
        self.send_queries(now_s)

    def send_queries(self, now_s: float) -> None:
        """Send the queries for names that are due."""
        for due in self._state.resolver.queries_to_send(now_s):
            revoked = self._state.policy.revoked.digest_about(due.name) if due.is_watch else None
            wire = self._state.identity.signed(Query(due.name, due.watch_s, revoked))
            self._to_rib(wire, now_s, self._rib_for(due, now_s))

    def _trip_s(self, rib: Name) -> float:
        """Return the round trip of the link towards a RIB, in seconds; 0: not measured, or the RIB is here."""
        way, _ = self._state.paths.to_rib(rib, self._state.policy.transit)
        return 0.0 if way is None else self._state.neighbours.rtt_to(way.first)

    def _leave_silent_rib(self, silent: Name, now_s: float) -> None:
        """Avoid a RIB; if it is the one in use, switch to another, and where there is none, serve known locations."""
        self._avoided = {rib: until_s for rib, until_s in self._avoided.items() if until_s > now_s}
        self._avoided[silent] = self._review_s = now_s + REFUSED_S
        self._owed.pop(silent, None)
        if silent == self.rib:
            self._state.resolver.cache.serve_stale(True, now_s)
            if [rib.name for rib in self._reached(now_s)[:1]] != [silent]:
                self.links_changed(now_s)

    def relay(self, statement: bytes, now_s: float) -> None:
        """Relay an attached node's advertisement or withdrawal, or a revocation, to the RIB."""
        self._to_rib(relayed(statement, self._state.identity, self._state.policy.transit), now_s)

    def _to_rib(self, statement: bytes, now_s: float, rib: Name | None = None) -> None:
        rib = rib or self.rib
        if rib is None:
            return
        self._owed.setdefault(rib, now_s)
        self._asked.pop(rib, None)
        self._asked[rib] = None
        if len(self._asked) > 8:
            del self._asked[next(iter(self._asked))]
        self._channels.send_query(rib, statement, now_s)
        self._send(now_s)

    def _send(self, now_s: float) -> None:
        for each in self._channels.records_to_send():
            self._unicast.send_statement(Kind.RIB_REQUEST, each.wire, each.to, now_s)

    def open(self, wire: bytes, sender: Name, now: Timestamps) -> Opened | None:
        """Handle a message for this switch; return its statement, if it is for more than the channel to a RIB.

        Raises:
            RemoteError: it is not valid.
        """
        opened = self._channels.receive(wire, sender, now)
        self._send(now.mono_s)
        return opened

    def receive(self, statement: Statement, now: Timestamps, *, is_fresh: bool) -> None:
        """Handle a RIB's response, AdvertiseAck or presence question, or the context of a node's former switch.

        Any RIB of a trusted domain may send a presence question: a tier above may know of another node.

        Args:
            is_fresh: it came in the channel to its signer.

        Raises:
            StatementError: it is not valid, or its sender received no query.
        """
        fields = statement.fields
        member = self._state.policy.verify_membership(CERTIFICATE.read(fields), now.unix_s)
        if statement.type is StatementType.PRESENCE and member.role is Role.RIB and member.name == statement.signer:
            statement.verify(member.key)
            self.presence.handle_question(Presence.from_fields(fields), member.name, statement.wire, now.mono_s)
            return
        self._check_asked(statement, member, now.mono_s)
        if member.role.is_switch:
            self._take_context(statement, now)
            return
        if not is_fresh:
            raise StatementError(DropReason.NO_CHANNEL, "an answer that may be a recorded one")
        self._rib_answered(member.name, now.mono_s)
        if statement.type is StatementType.ADVERTISE_ACK:
            self._handle_ack(statement)
            return
        if statement.type is StatementType.SYNC:
            self.endpoints.receive(SyncMessage.from_fields(fields), now)
            return
        statement.expect(StatementType.ANSWER)
        response = Response.from_fields(fields)
        if response.is_negative:
            self._receive_negative(response.name, member, now.mono_s)
        elif response.is_unknown:
            self._receive_unknown(response.name, member.name, now.mono_s)
        elif not response.advertisement:
            self._locations.receive_removal(response, now.mono_s)
        else:
            self._found(response, member, statement.wire, now)

    def revocation_in(self, statement: Statement, now: Timestamps) -> tuple[Statement, Name]:
        """Return the revocation, to be verified, that a RIB forwarded, and the RIB.

        Raises:
            StatementError: the sender is no RIB that received a query, or the statement is another one.
        """
        relay = RelayedStatement.from_fields(statement.expect(StatementType.RELAY))
        member = self._state.policy.verify_membership(relay.membership, now.unix_s)
        if member.role is not Role.RIB:
            raise StatementError(DropReason.WRONG_DOMAIN, "a revocation that no RIB passed on")
        self._check_asked(statement, member, now.mono_s)
        return parse(relay.statement), member.name

    def _check_asked(self, statement: Statement, member: Membership, now_s: float) -> None:
        if member.name != statement.signer or not self._was_asked(member, now_s):
            raise StatementError(DropReason.WRONG_DOMAIN, "an answer from a node that was not asked")
        statement.verify(member.key)

    def _was_asked(self, member: Membership, now_s: float) -> bool:
        if member.role is Role.RIB:
            return member.domain == self._state.policy.own or member.name in self._asked
        return member.role.is_switch and self._relocations.is_former(member.name, now_s)

    def _rib_answered(self, rib: Name, now_s: float) -> None:
        self._avoided.pop(rib, None)
        self._owed.pop(rib, None)
        if rib == self.rib:
            self._state.resolver.cache.serve_stale(False, now_s)

    def _found(self, response: Response, member: Membership, wire: bytes, now: Timestamps) -> None:
        try:
            place = self._locations.verified(response, now, self._source(member.name))
        except StatementError:
            # it is of no use here, but still counts as a response
            self._receive_negative(response.name, member, now.mono_s)
            raise
        self._locations.receive(place, wire, now.mono_s)

    def _source(self, rib: Name) -> tuple[Name, bytes]:
        known = self._state.paths.ribs().get(rib)
        return rib, b"" if known is None else known.session

    def _receive_negative(self, name: Name, member: Membership, now_s: float) -> None:
        """Store that no node advertises a name, if the RIB can know; one that has just started does not know all yet.

        It can where it gave the known locations since it started, or where they and this switch are in its domain.
        """
        source, own = self._source(member.name), self._state.policy.own
        for place in self._state.resolver.cache.of(name, now_s):
            if place.source != source and not (place.domain == member.domain == own):
                self._receive_unknown(name, member.name, now_s)
                return
        self._state.resolver.receive_negative(name, now_s, keep=now_s - self._chosen_s < _REFILL_S)

    def _receive_unknown(self, name: Name, rib: Name, now_s: float) -> None:
        """Keep the known locations of a name; query other RIBs where the own domain has none."""
        self._state.resolver.receive_unknown(name, rib, now_s, {each.name for each in self._others})

    def _take_context(self, statement: Statement, now: Timestamps) -> None:
        """Handle the names that a node reads, from the node's former switch; a RIB's information takes precedence."""
        if statement.type is StatementType.ADVERTISE_ACK:
            ack = AdvertiseAck.from_fields(statement.fields)
            self._relocations.acknowledged(ack.name, ack.advertiser, ack.sequence)
            return
        statement.expect(StatementType.ANSWER)
        place = self._locations.verified(Response.from_fields(statement.fields), now)
        known = self._state.resolver.cache.get(place.name, place.advertiser)
        if known is None or known.sequence < place.sequence:
            self._locations.receive(place, statement.wire, now.mono_s)

    def _handle_ack(self, statement: Statement) -> None:
        ack = AdvertiseAck.from_fields(statement.fields)
        taken = ack.sequence if ack.refused is None else None
        attachment = self._state.attached.handle_ack(ack.name, ack.advertiser, taken)
        if attachment is not None:
            self._state.outbox.say_at(attachment.port, attachment.mac, Kind.ADVERTISE_ACK, statement.wire)
            if ack.refused is DropReason.IN_USE:  # the older node with this identity is elsewhere
                self._state.attached.remove(ack.name, ack.advertiser)
                self._unicast.remove(ack.name)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next query, or of the moment to leave a silent RIB."""
        of_names = earliest(self._state.attached.next_event(), self._state.resolver.next_query(), self._review_s)
        owed_s = min(self._owed.values()) + SILENT_S if self._owed else None
        due_s = earliest(of_names, owed_s, self.endpoints.get_timer(), self._channels.get_timer())
        return None if self.rib is None else due_s
