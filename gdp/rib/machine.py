"""A RIB: who advertises a name, and where, by proof alone.

Place: pure; it takes statements and gives back statements to send, each for a name. How they travel is its host's
business (``gdp/client/rib_host.py``).

It accepts an advertisement only if the name's hash comes out, the chain from the owner's key to the claimant holds, the
relay is a member of this domain (or a RIB of a trusted one), the sequence number is newer, the lease is in bounds and
the quota not spent. Global names climb to the tier above; what this tier does not know is asked there.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from gdp.control.query import Answer, Query
from gdp.control.relay import Relay
from gdp.control.verdict import Verdict
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.effects import Instant
from gdp.errors import DropReason, RemoteError, StatementError
from gdp.frame.kinds import Kind
from gdp.limits import LEASE_MAX_S, NEGATIVE_LEASE_S, RIB_NAMES_PER_SENDER, RIB_WATCHES_MAX
from gdp.names import Name
from gdp.rib.above import Above
from gdp.rib.route import Route, Withdrawn
from gdp.rib.store import Store
from gdp.rib.watches import Watches
from gdp.trust.claim import Claim, ClaimBody
from gdp.trust.domain import Policy
from gdp.trust.verifier import ClaimVerifier

__all__ = ["Letter", "Rib", "RibSettings"]

_ADVISED_S: Final = 30.0


class Letter(NamedTuple):
    """A statement to send to a name."""

    to: Name
    kind: Kind
    statement: bytes


@dataclass(frozen=True, slots=True)
class RibSettings:
    """What an operator may choose."""

    upper: Name | None = None
    allow_unowned: bool = False
    names_per_sender: int = RIB_NAMES_PER_SENDER
    watches: int = RIB_WATCHES_MAX
    lease_max_s: float = LEASE_MAX_S


class Rib:
    """The machine of one RIB."""

    def __init__(self, identity: Identity, policy: Policy, store: Store, settings: RibSettings) -> None:
        self._identity = identity
        self._policy = policy
        self._store = store
        self._settings = settings
        self._verifier = ClaimVerifier(policy, allow_unowned=settings.allow_unowned)
        self._watches = Watches(settings.watches)
        self._above = Above(settings.upper)
        self._letters: list[Letter] = []
        self.refusals: Counter[DropReason] = Counter()
        self.accepted = 0
        self.answers = 0
        self.negative_answers = 0

    @property
    def names(self) -> int:
        """Return how many routes are kept."""
        return len(self._store)

    @property
    def watching(self) -> int:
        """Return how many watches stand."""
        return len(self._watches)

    def receive(self, wire: bytes, sender: Name, now: Instant) -> None:
        """Take a statement that came from ``sender`` (as the frame says; unproven). What does not hold is counted."""
        try:
            statement = parse(wire)
            if statement.signer != sender:
                raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
            if statement.type is StatementType.RELAY:
                self._take_relay(statement, now)
            elif statement.type is StatementType.QUERY:
                self._take_query(statement, now)
            elif statement.type is StatementType.ANSWER:
                self._take_answer_from_above(statement, now)
            elif statement.type is not StatementType.VERDICT:
                raise StatementError(DropReason.MALFORMED, f"a RIB takes no {statement.type.value}")
        except RemoteError as error:
            self.refusals[error.reason] += 1

    def revoke(self, wire: bytes, now: Instant) -> None:
        """Take a certificate back: what rests on it is gone, and whoever watched is told.

        What does not hold is counted.
        """
        try:
            revocation = self._verifier.revoke(wire, now.unix_s)
        except RemoteError as error:
            self.refusals[error.reason] += 1
            return
        if revocation is None:
            return
        for route in self._store.resting_on(revocation.fingerprint):
            try:
                self._verifier.verify(route.claim, now.unix_s)
            except StatementError:
                self._store.withdraw(route.name, route.advertiser)
                self._tell_gone(route, now.mono_s)

    def timeout(self, now: Instant) -> None:
        """Let expired routes go and tell who watched them; ask above again what is open."""
        for route in self._store.expire(now.mono_s, now.unix_s):
            self._tell_gone(route, now.mono_s)
        self._watches.expire(now.mono_s)
        ask, given_up = self._above.due(now.mono_s)
        for name, watch_s in ask:
            self._ask_above(name, watch_s)
        for name, askers in given_up:
            for asker in askers:
                self._answer_nobody(name, asker)

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._store.next_expiry(), self._above.next_due()]
        return min((time for time in times if time is not None), default=None)

    def take(self) -> list[Letter]:
        """Return, once, what is to be sent."""
        letters, self._letters = self._letters, []
        return letters

    # -- advertisements

    def _take_relay(self, statement: Statement, now: Instant) -> None:
        relay = Relay.from_fields(statement.fields)
        member = self._sender(relay.membership, statement, now)
        is_own_switch = member.role is Role.SWITCH and member.domain == self._policy.own
        if not is_own_switch and member.role is not Role.RIB:
            raise StatementError(DropReason.WRONG_DOMAIN, "relays are switches of this domain, or RIBs")
        statement.verify(member.key)
        passed_on = parse(relay.statement)
        if passed_on.type is StatementType.WITHDRAW:
            self._take_withdrawal(passed_on, member, now)
            return
        try:
            claim = self._verifier.verify_statement(passed_on, now.unix_s)
            if is_own_switch and claim.switch != member.name:
                raise StatementError(DropReason.NOT_DELEGATED, "the RtCert names another switch than the relay")
            known = self._check_news(claim, member)
        except StatementError as error:
            self._refuse(passed_on, member, error)
            raise
        route = self._route(claim, relay.transit, member, now)
        self._store.put(route)
        self.accepted += 1
        self._judge(route.name, route.advertiser, None, route.sequence, member.name)
        self._tell(route, now.mono_s)
        if isinstance(known, Route) and known.sender != route.sender:
            self._answer(route, known.sender, now.mono_s)  # it has moved: whoever brought it before must know
        if claim.is_global and self._settings.upper not in (None, member.name):
            self._pass_up(relay.statement, relay.transit, member)

    def _check_news(self, claim: Claim, member: Membership) -> Route | Withdrawn | None:
        """Return what was known before of a claim that may be taken.

        Raises:
            StatementError: STALE, LEASE_BOUNDS or QUOTA.
        """
        if claim.lease_s > self._settings.lease_max_s:
            raise StatementError(DropReason.LEASE_BOUNDS)
        known = self._store.get(claim.name, claim.node)
        if known is not None and claim.sequence <= known.sequence:
            is_repeated = isinstance(known, Route) and (known.claim, known.domain) == (claim.wire, member.domain)
            if not is_repeated:
                raise StatementError(DropReason.STALE, str(known.sequence))
        is_new = known is None or known.sender != member.name
        if is_new and self._store.count_of(member.name) >= self._settings.names_per_sender:
            raise StatementError(DropReason.QUOTA, "names of one sender")
        return known

    def _route(self, claim: Claim, transit: tuple[Name, ...], member: Membership, now: Instant) -> Route:
        left_s = max(claim.valid_until_unix_s - now.unix_s, 1.0)
        return Route(
            name=claim.name,
            advertiser=claim.node,
            sender=member.name,
            domain=member.domain,
            transit=transit if member.role is Role.RIB else tuple(sorted(self._policy.transit)),
            sequence=claim.sequence,
            is_global=claim.is_global,
            claim=claim.wire,
            is_from_above=False,
            expires_s=now.mono_s + min(claim.lease_s, left_s),
            valid_until_unix_s=claim.valid_until_unix_s,
            fingerprints=claim.fingerprints,
        )

    def _take_withdrawal(self, withdrawal: Statement, member: Membership, now: Instant) -> None:
        fields = withdrawal.expect(StatementType.WITHDRAW)
        name, advertiser, sequence = fields.name("n"), withdrawal.signer, fields.uint("s")
        known = self._store.get(name, advertiser)
        if not isinstance(known, Route) or sequence < known.sequence:
            raise StatementError(DropReason.STALE, "nothing to withdraw")
        claimed = ClaimBody.from_statement(parse(known.claim))
        withdrawal.verify(self._policy.verify_membership(claimed.membership, now.unix_s).key)
        self._store.withdraw(name, advertiser)
        self._judge(name, advertiser, None, sequence, member.name)
        self._tell_gone(known, now.mono_s)
        if known.is_global and self._settings.upper not in (None, member.name):
            self._pass_up(withdrawal.wire, (), member)

    def _pass_up(self, statement: bytes, transit: tuple[Name, ...], member: Membership) -> None:
        upper = self._settings.upper
        assert upper is not None
        passed = transit if member.role is Role.RIB else tuple(sorted(self._policy.transit))
        relay = Relay(statement, passed, self._identity.membership)
        self._letters.append(Letter(upper, Kind.RIB_REQUEST, relay.to_wire(self._identity.name, self._identity.key)))

    def _refuse(self, passed_on: Statement, member: Membership, error: StatementError) -> None:
        """Tell a proven relay why a claim was not taken."""
        try:
            name = ClaimBody.from_statement(passed_on).subject.name
        except StatementError:
            return  # not even a claim: nothing to name in an answer; the caller counts it
        known = self._store.get(name, passed_on.signer)
        self._judge(name, passed_on.signer, error.reason, 0 if known is None else known.sequence, member.name)

    def _judge(
        self, name: Name, advertiser: Name, refused: DropReason | None, sequence: int, to: Name
    ) -> None:
        verdict = Verdict(name, advertiser, refused, sequence)
        wire = verdict.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._letters.append(Letter(to, Kind.RIB_ANSWER, wire))

    # -- questions

    def _take_query(self, statement: Statement, now: Instant) -> None:
        fields = statement.fields
        member = self._sender(fields.bytes_("c"), statement, now)
        if member.role is Role.SWITCH and member.domain != self._policy.own:
            raise StatementError(DropReason.WRONG_DOMAIN, "switches ask the RIB of their own domain")
        statement.verify(member.key)
        query = Query.from_fields(fields)
        if query.watch_s > 0:
            self._watch(query, member.name, now.mono_s)
        routes = [route for route in self._store.routes(query.name) if self._may_tell(route, member)]
        for route in routes:
            self._answer(route, member.name, now.mono_s)
        is_asked = self._above.want(query.name, member.name, query.watch_s, now.mono_s, is_known=bool(routes))
        if is_asked:
            self._ask_above(query.name, self._above.watch_s(query.name))
        elif not routes and not self._above.is_waiting(query.name):
            self._answer_nobody(query.name, member.name)

    def _watch(self, query: Query, watcher: Name, now_s: float) -> None:
        """Watch for an asker; where there are too many watches it is answered all the same, and will ask again."""
        try:
            self._watches.add(query.name, watcher, now_s + query.watch_s)
        except StatementError as error:
            self.refusals[error.reason] += 1

    def _may_tell(self, route: Route, asker: Membership) -> bool:
        """Return whether an asker may learn of a route: what is not global stays in its domain."""
        is_allowed = route.is_global or asker.domain == self._policy.own
        return is_allowed and not self._is_its_own(route, asker.name)

    def _is_its_own(self, route: Route, asker: Name) -> bool:
        """Return whether a RIB below told us of this route itself."""
        return route.sender == asker and route.domain != self._policy.own

    def _answer(self, route: Route, to: Name, now_s: float) -> None:
        lease_s = min(max(route.expires_s - now_s, 0.0), _ADVISED_S)
        answer = Answer(route.name, route.advertiser, route.claim, route.domain, route.transit, lease_s)
        self.answers += 1
        self._send(answer, to)

    def _answer_nobody(self, name: Name, to: Name) -> None:
        self.negative_answers += 1
        self._send(Answer(name, name, b"", self._policy.own, (), NEGATIVE_LEASE_S), to)

    def _send(self, answer: Answer, to: Name) -> None:
        wire = answer.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._letters.append(Letter(to, Kind.RIB_ANSWER, wire))

    def _tell(self, route: Route, now_s: float) -> None:
        for watcher in self._watches.watchers(route.name, now_s):
            if not self._is_its_own(route, watcher):
                self._answer(route, watcher, now_s)

    def _tell_gone(self, route: Route, now_s: float) -> None:
        for watcher in self._watches.watchers(route.name, now_s):
            self._send(Answer(route.name, route.advertiser, b"", route.domain, (), 0.0), watcher)

    # -- the tier above

    def _ask_above(self, name: Name, watch_s: float) -> None:
        upper = self._settings.upper
        assert upper is not None
        query = Query(name, watch_s)
        wire = query.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._letters.append(Letter(upper, Kind.RIB_REQUEST, wire))

    def _take_answer_from_above(self, statement: Statement, now: Instant) -> None:
        fields = statement.fields
        member = self._sender(fields.bytes_("c"), statement, now)
        if member.name != self._settings.upper or member.role is not Role.RIB:
            raise StatementError(DropReason.WRONG_DOMAIN, "an answer from no tier above")
        statement.verify(member.key)
        answer = Answer.from_fields(fields)
        if answer.is_nobody:
            askers = self._above.answered(answer.name, now.mono_s)
            if not self._store.routes(answer.name):
                for asker in askers:
                    self._answer_nobody(answer.name, asker)
            return
        known = self._store.get(answer.name, answer.advertiser)
        if not answer.claim:
            if isinstance(known, Route) and known.is_from_above:
                self._store.withdraw(answer.name, answer.advertiser)
                self._tell_gone(known, now.mono_s)
            return
        self._learn_from_above(answer, member, known, now)

    def _learn_from_above(self, answer: Answer, member: Membership, known: object, now: Instant) -> None:
        claim = self._verifier.verify(answer.claim, now.unix_s)
        if claim.name != answer.name or claim.node != answer.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "an answer about something else than its claim")
        if answer.domain == self._policy.own:
            return  # our own, come back from above
        if isinstance(known, Route) and claim.sequence < known.sequence:
            raise StatementError(DropReason.STALE, "the tier above is behind")
        route = replace(
            self._route(claim, answer.transit, member, now),
            domain=answer.domain,
            is_from_above=True,
            expires_s=now.mono_s + answer.lease_s,
        )
        self._store.put(route)
        askers = self._above.answered(answer.name, now.mono_s)
        for asker in dict.fromkeys([*askers, *self._watches.watchers(route.name, now.mono_s)]):
            self._answer(route, asker, now.mono_s)

    def _sender(self, membership: bytes, statement: Statement, now: Instant) -> Membership:
        member = self._policy.verify_membership(membership, now.unix_s)
        if member.name != statement.signer:
            raise StatementError(DropReason.BAD_CERTIFICATE, "the membership is of another node")
        return member
