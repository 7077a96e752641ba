"""Location updates: verified statements come in; name cache, routes, trees and attached readers follow.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Each location is verified first: a
RIB's response and a switch's relay carry the node's own advertisement, which names its switch by an RtCert. Only the
domain and its transit rest on the signer alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.control.rib_statements import AdvertiseAck, Query, RelayedStatement, Response, relayed
from gdp.crypto.certificates import Role
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.limits import COST_UNREACHABLE
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.switch.forwarding_state import ForwardingState, KnownLocation
from gdp.switch.multicast import MulticastTrees
from gdp.switch.name_cache import Location
from gdp.switch.relocation import Relocations
from gdp.switch.trees import Downstream
from gdp.switch.unicast import Unicast
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import HEARS, Right

PROOFS_MAX: Final = 8  # statements in one reply to a neighbour


class LocationUpdates:
    """Applies location updates at one switch, and sends known locations to others."""

    def __init__(
        self,
        state: ForwardingState,
        multicast: MulticastTrees,
        unicast: Unicast,
        relocations: Relocations,
    ) -> None:
        self._state = state
        self._multicast = multicast
        self._unicast = unicast
        self._relocations = relocations

    def is_newer(self, location: Location) -> bool:
        """Return whether a location is newer than what is known of its advertiser, here or elsewhere."""
        attachment = self._state.attached.get(location.name, location.advertiser)
        known = self._state.resolver.cache.get(location.name, location.advertiser)
        newest = max(
            -1 if attachment is None else attachment.advertisement.sequence, -1 if known is None else known.sequence
        )
        return location.sequence > newest

    def verified(self, response: Response, now: Timestamps, source: tuple[Name, bytes] | None = None) -> Location:
        """Return the location in a response whose signature was verified.

        Args:
            source: the RIB that sent it, and that RIB's session.

        Raises:
            StatementError: its advertisement is not valid, or is about something else.
        """
        advertisement = self._state.verifier.verify(response.advertisement, now.unix_s)
        if advertisement.name != response.name or advertisement.node != response.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "an answer about something else than its advertisement")
        transit = frozenset(response.transit)
        return _location(advertisement, response.domain, transit, response.lease_s, now, source)

    def _from_forwarded_answer(self, statement: Statement, now: Timestamps) -> Location:
        """Return the location in a response that was forwarded; any RIB of a trusted domain may have issued it."""
        fields = statement.expect(StatementType.ANSWER)
        member = self._state.policy.verify_sender(statement, now.unix_s)
        if not (member.role.is_switch or member.role is Role.RIB):
            raise StatementError(DropReason.BAD_CERTIFICATE, "an answer from a node without the right to give it")
        statement.verify(member.key)
        response = Response.from_fields(fields)
        if not response.advertisement:
            raise StatementError(DropReason.MALFORMED, "a redirect to nowhere")
        return self.verified(response, now)

    def _from_relay(self, statement: Statement, now: Timestamps) -> Location:
        """Return the location that a switch reports of a node that is attached to it."""
        relay = RelayedStatement.from_fields(statement.expect(StatementType.RELAY))
        member = self._state.policy.verify_sender(statement, now.unix_s)
        if not member.role.is_switch:
            raise StatementError(DropReason.BAD_CERTIFICATE, "a relay that is not from a switch")
        statement.verify(member.key)
        advertisement = self._state.verifier.verify_statement(parse(relay.statement), now.unix_s)
        if advertisement.switch != member.name:
            raise StatementError(DropReason.NOT_DELEGATED, "the RtCert names another switch")
        return _location(advertisement, member.domain, frozenset(relay.transit), advertisement.lease_s, now)

    def receive(self, location: Location, statement: bytes, now_s: float) -> None:
        """Store where an advertiser is, and update everything that depends on it; ``statement``: the proof of it."""
        is_ours = location.switch == self._state.me
        attachment = self._state.attached.get(location.name, location.advertiser)
        if attachment is not None and attachment.advertisement.sequence < location.sequence and not is_ours:
            self._state.attached.depart(location.name, location.advertiser, now_s)  # it has moved to another switch
            self._unicast.remove(location.name)
        before = self._state.resolver.cache.get(location.name, location.advertiser)
        if before is not None and before.sequence > location.sequence:
            # the sender's information is older
            location = replace(before, expires_s=max(before.expires_s, location.expires_s))
        if location.proof is not None:
            self._state.dependents.record(KnownLocation(location.name, location.advertiser), location.proof)
        self._state.resolver.receive_location(location, now_s, is_ours=is_ours, has_left=is_ours and attachment is None)
        has_readers = location.right in HEARS.values()
        names = dict.fromkeys((location.name, location.advertiser))
        if before is None or (before.switch, before.domain) != (location.switch, location.domain):
            self._unicast.remove(*names)
            if has_readers:
                self._multicast.publisher_moved(location, now_s)
            if not is_ours and self._state.attached.was_here(location.name, location.advertiser, now_s):
                self._relocations.moved(location, statement, now_s)
        if has_readers:
            self._multicast.publisher_found(location, now_s)
            if before is None or before.advertisement != location.advertisement:
                for at, reader in self._state.readers.of(location.name).items():
                    self.send_to_reader(at, reader.advertisement.right, location, now_s)
        for name in names:
            self._unicast.release(name, now_s)

    def receive_relocation(self, statement: Statement, now: Timestamps) -> None:
        """Handle the new location of a node that was attached here; send its new switch the names that it reads.

        Raises:
            StatementError: it is not valid.
        """
        location, now_s = self._from_relay(statement, now), now.mono_s
        if location.right in HEARS:
            self._multicast.reader_moved(location)
        self.acknowledge_relocation(location, now_s)
        if location.right is not Right.READ and self.is_newer(location):
            self.receive(location, statement.wire, now_s)

    def receive_redirect(self, _neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle a redirect: a neighbour that received our frames for a node reports where that node is now.

        Raises:
            StatementError: it is not valid, or contains no location.
        """
        is_relay = statement.type is StatementType.RELAY
        location = self._from_relay(statement, now) if is_relay else self._from_forwarded_answer(statement, now)
        if self.is_newer(location):
            is_known = self._state.resolver.cache.get(location.name, location.advertiser) is not None
            has_moved = is_known or self._state.trees.get(location.name, location.advertiser) is not None
            self.receive(location, statement.wire, now.mono_s)
            if has_moved:
                self._relocations.moved(location, statement.wire, now.mono_s)

    def answer_query(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Reply to a neighbour that receives our frames for a node with that node's location.

        Raises:
            StatementError: the neighbour is no switch, or did not sign.
        """
        query = Query.from_fields(statement.expect(StatementType.QUERY))
        if not neighbour.role.is_switch or statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a question that a neighbouring switch did not ask")
        statement.verify(neighbour.key)
        for known in self.proofs_of(query.name, now.mono_s):
            self._state.outbox.send_to_neighbour(neighbour, Kind.REDIRECT, known)

    def receive_removal(self, response: Response, now_s: float) -> None:
        """Remove an advertiser that has withdrawn.

        Raises:
            StatementError: STALE, the known advertisement is newer.
        """
        known = self._state.resolver.cache.get(response.name, response.advertiser)
        if known is not None and known.sequence > response.sequence:
            raise StatementError(DropReason.STALE, "a removal of an earlier advertisement")
        self._state.resolver.receive_removal(response.name, response.advertiser, now_s)
        self._multicast.publisher_gone(response.name, response.advertiser)
        self._unicast.remove(response.name)
        wire = self._state.identity.signed(response)
        for at in self._state.readers.of(response.name):
            self._state.outbox.say_at(*at, Kind.ADVERTISE_ACK, wire)

    def expire(self, now_s: float) -> None:
        """Remove locations that no RIB has confirmed for a lease, and frames that waited too long."""
        for location in self._state.resolver.expire(now_s):
            self._multicast.publisher_gone(location.name, location.advertiser)

    def send_to_reader(self, at: Downstream, right: Right, location: Location, now_s: float) -> None:
        """Send an advertiser's advertisement to an attached node that reads it by ``right``; the node verifies it.

        One that wants costs also receives that of the path to the advertiser.
        """
        if HEARS[right] is not location.right:
            return
        cost, reader = None, self._state.readers.of(location.name).get(at)
        if reader is not None and reader.advertisement.wants_costs:
            cost = reader.costs[location.advertiser] = self._cost_of(location)
        self._state.outbox.say_at(*at, Kind.ADVERTISE_ACK, self._as_answer(location, now_s, cost))

    def paths_changed(self, now_s: float) -> None:
        """Send readers that want costs the locations whose costs have changed."""
        for at, reader in self._state.readers.wanting_costs():
            right = reader.advertisement.right
            for location in self._state.resolver.cache.of(reader.advertisement.name, now_s):
                if reader.costs.get(location.advertiser) != self._cost_of(location):
                    self.send_to_reader(at, right, location, now_s)

    def _cost_of(self, location: Location) -> int:
        if location.switch == self._state.me:
            return 0
        path = self._unicast.path_to(location, self._state.policy.transit)
        return COST_UNREACHABLE if path is None else min(path.distance, COST_UNREACHABLE)

    def acknowledge_relocation(self, moved: Location, now_s: float) -> None:
        """Send a node's new switch an acknowledgement, and the locations of the advertisers that the node reads."""
        statements = [self._state.identity.signed(AdvertiseAck(moved.name, moved.advertiser, None, moved.sequence))]
        for location in self._state.resolver.cache.of(moved.name, now_s):
            if HEARS.get(moved.right) is location.right:
                statements.append(self._as_answer(location, now_s))
        for statement in statements:
            self._unicast.send_statement(Kind.RIB_ANSWER, statement, moved.switch, now_s)

    def proofs_of(self, name: Name, now_s: float) -> list[bytes]:
        """Return statements that prove the location of a node, or of a name's advertisers; at most ``PROOFS_MAX``."""
        attachment = self._state.attached.at(name)
        if attachment is not None:
            return [relayed(attachment.advertisement.wire, self._state.identity, self._state.policy.transit)]
        cache = self._state.resolver.cache
        node = cache.of_node(name, now_s)
        locations = cache.of(name, now_s) + ([] if node is None else [node])
        return [self._as_answer(location, now_s) for location in locations[:PROOFS_MAX]]

    def _as_answer(self, location: Location, now_s: float, cost: int | None = None) -> bytes:
        lease_s = max(location.expires_s - now_s, 0.0)
        response = Response(
            name=location.name,
            advertiser=location.advertiser,
            advertisement=location.advertisement,
            domain=location.domain,
            transit=tuple(sorted(location.transit)),
            lease_s=lease_s,
            cost=cost,
        )
        return self._state.identity.signed(response)


def _location(
    advertisement: Advertisement,
    domain: Name,
    transit: frozenset[Name],
    lease_s: float,
    now: Timestamps,
    source: tuple[Name, bytes] | None = None,
) -> Location:
    return Location(
        name=advertisement.name,
        advertiser=advertisement.node,
        right=advertisement.right,
        switch=advertisement.switch,
        domain=domain,
        transit=transit,
        advertisement=advertisement.wire,
        expires_s=now.mono_s + lease_s,
        proof=advertisement,
        stale_until_s=now.mono_s + advertisement.valid_until_unix_s - now.unix_s,
        source=source,
    )
