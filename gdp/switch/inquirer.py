"""A switch's dealings with its RIB: relay what attached nodes claim, ask where names are, take the answers in.

Place: pure; time comes in as ``now_s`` (monotonic seconds). Only a RIB of the switch's own domain is believed, and its
answers carry the claims themselves, which readers verify again.
"""

from __future__ import annotations

from gdp.control.query import Answer, Query
from gdp.control.relay import Relay
from gdp.control.verdict import Verdict
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.effects import Instant
from gdp.errors import DropReason, StatementError
from gdp.frame.kinds import Kind
from gdp.names import Name
from gdp.switch.attached import Attached
from gdp.switch.outbox import Outbox
from gdp.switch.parked import Parked
from gdp.switch.paths import Paths
from gdp.switch.places import WATCH_S, Place, Places
from gdp.switch.planter import Planter
from gdp.switch.trees import At
from gdp.switch.unicast import Unicast
from gdp.trust.claim import ClaimBody
from gdp.trust.domain import Policy
from gdp.trust.right import HEARS, Right

__all__ = ["Inquirer"]


class Inquirer:
    """Speaks with the nearest RIB of the switch's domain.

    Attributes:
        rib: whom it asks, or None while none is known.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        paths: Paths,
        attached: Attached,
        places: Places,
        parked: Parked,
        planter: Planter,
        unicast: Unicast,
        outbox: Outbox,
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._paths = paths
        self._attached = attached
        self._places = places
        self._parked = parked
        self._planter = planter
        self._unicast = unicast
        self._outbox = outbox
        self.rib: Name | None = None

    def links_changed(self, now_s: float) -> None:
        """Choose the RIB anew; a new one is told and asked everything."""
        rib = self._nearest_rib()
        if rib != self.rib:
            self.rib = rib
            self._attached.relay_all(now_s)
            self._places.ask_again(now_s)
        self.ask(now_s)

    def _nearest_rib(self) -> Name | None:
        ribs = self._paths.ribs()
        ways = {rib: self._paths.to_rib(rib, frozenset({self._policy.own})) for rib in ribs}
        reached = [
            (0 if way is None else way.distance, rib)
            for rib, (way, host) in ways.items()
            if host is not None
        ]
        return min(reached, default=(0, None))[1]

    def ask(self, now_s: float) -> None:
        """Relay and ask what is due."""
        if self.rib is None:
            return
        for attachment in self._attached.due(now_s):
            self.relay(attachment.claim.wire, now_s)
        questions, given_up = self._places.due(now_s)
        for name, is_watch in questions:
            query = Query(name, WATCH_S if is_watch else 0.0)
            self._to_rib(query.to_wire(self._identity.name, self._identity.key, self._identity.membership), now_s)
        for name in given_up:
            self._parked.refuse(name, DropReason.NO_ROUTE)

    def relay(self, statement: bytes, now_s: float) -> None:
        """Pass an attached node's claim or withdrawal on to the RIB."""
        relay = Relay(statement, tuple(sorted(self._policy.transit)), self._identity.membership)
        self._to_rib(relay.to_wire(self._identity.name, self._identity.key), now_s)

    def _to_rib(self, statement: bytes, now_s: float) -> None:
        if self.rib is not None:
            frames = self._outbox.far(Kind.RIB_REQUEST, statement, self.rib)
            self._unicast.send(frames, self.rib, self._identity.name, now_s)

    def receive(self, statement: Statement, now: Instant) -> None:
        """Take a RIB's answer or verdict.

        Raises:
            StatementError: it does not hold, or is not from a RIB of our domain.
        """
        fields = statement.fields
        member = self._policy.verify_membership(fields.bytes_("c"), now.unix_s)
        if member.role is not Role.RIB or member.domain != self._policy.own or member.name != statement.signer:
            raise StatementError(DropReason.WRONG_DOMAIN, "an answer that is not from a RIB of ours")
        statement.verify(member.key)
        if statement.type is StatementType.VERDICT:
            self._take_verdict(statement)
            return
        statement.expect(StatementType.ANSWER)
        answer = Answer.from_fields(fields)
        if answer.is_nobody:
            self._nobody(answer.name, now.mono_s)
        elif not answer.claim:
            self._gone(answer, now.mono_s)
        else:
            self._found(answer, now.mono_s)

    def _found(self, answer: Answer, now_s: float) -> None:
        claim = parse(answer.claim)
        body = ClaimBody.from_statement(claim)
        if body.subject.name != answer.name or claim.signer != answer.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "an answer about something else than its claim")
        switch = parse(body.rtcert).fields.name("switch")
        place = Place(
            answer.name, answer.advertiser, body.right, switch, answer.domain, frozenset(answer.transit),
            answer.claim, now_s + answer.lease_s,
        )  # fmt: skip
        attachment = self._attached.get(place.name, place.advertiser)
        if attachment is not None and attachment.claim.sequence < body.sequence and switch != self._identity.name:
            self._attached.remove(place.name, place.advertiser)  # it has moved to another switch
            self._unicast.forget(place.name)
        before = self._places.put(place, now_s, is_ours=switch == self._identity.name)
        if before is None or (before.switch, before.domain) != (place.switch, place.domain):
            self._unicast.forget(place.name)
        self._planter.publisher_found(place, now_s)
        if before is None or before.claim != place.claim:
            for at, right in self._planter.readers(place.name):
                self.tell_reader(at, right, place, now_s)
        self._unicast.release(place.name, now_s)

    def tell_reader(self, at: At, right: Right, place: Place, now_s: float) -> None:
        """Hand the claim of whoever an attached node hears, by its right, on to it; it verifies that itself."""
        if HEARS[right] is place.right:
            lease_s = max(place.expires_s - now_s, 0.0)
            answer = Answer(
                place.name, place.advertiser, place.claim, place.domain, tuple(sorted(place.transit)), lease_s
            )
            self._answer_reader(at, answer)

    def _gone(self, answer: Answer, now_s: float) -> None:
        self._places.remove(answer.name, answer.advertiser, now_s)
        self._planter.publisher_gone(answer.name, answer.advertiser)
        self._unicast.forget(answer.name)
        for at, _ in self._planter.readers(answer.name):
            self._answer_reader(at, answer)

    def _answer_reader(self, at: At, answer: Answer) -> None:
        wire = answer.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._outbox.say_at(*at, Kind.VERDICT, wire)

    def _nobody(self, name: Name, now_s: float) -> None:
        self._places.nobody(name, now_s)
        self._parked.refuse(name, DropReason.NO_ROUTE)

    def _take_verdict(self, statement: Statement) -> None:
        verdict = Verdict.from_fields(statement.fields)
        taken = verdict.sequence if verdict.refused is None else None
        attachment = self._attached.settle(verdict.name, verdict.advertiser, taken)
        if attachment is not None:
            self._outbox.say_at(attachment.port, attachment.mac, Kind.VERDICT, statement.wire)
