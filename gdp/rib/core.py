"""RIB of a domain: which nodes advertise a name, and at which switches, by proof alone.

Sans-I/O; it takes statements and returns statements to send, each for a name. Their transport is the task of its host
(``gdp/client/rib_host.py``).

It accepts an advertisement only if the name's hash is right and the chain from the owner's key to the advertiser is
valid. The relay must be a member of this domain (or a RIB of a trusted one). The sequence number must be newer, the
lease in bounds, and the quota not used up. Global names are also advertised to the tier above; names that this tier
does not know are queried there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from gdp.control.advertise_ack import AdvertiseAck
from gdp.control.boundary import ErrorBoundary
from gdp.control.endpoint_sync import ENDPOINTS
from gdp.control.presence import IdentityChecks, Presence
from gdp.control.query import Query, Response
from gdp.control.relayed_statement import RelayedStatement
from gdp.control.rib_replication import Entry, Key
from gdp.control.waiting import Wait, WaitReason
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity
from gdp.crypto.schema import NAME, Keyed
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.diagnosis.facts import RibFacts, RouteFact
from gdp.errors import DropReason, RemoteError, StatementError, StoreError
from gdp.exchange.sync_message import SyncMessage
from gdp.frame.kinds import Kind
from gdp.limits import (
    ANSWER_BYTES_BURST,
    ANSWER_BYTES_PER_S,
    CLOCK_SKEW_S,
    LEASE_MAX_S,
    NEGATIVE_LEASE_S,
    RIB_NAMES_PER_SENDER,
    RIB_WATCHES_MAX,
)
from gdp.names import NAME_BYTES, Name
from gdp.rib.endpoints import RibEndpoints
from gdp.rib.former import FormerAdvertisers
from gdp.rib.lower_ribs import LowerRibs
from gdp.rib.replication import ROUTES, Replication
from gdp.rib.revocations import RibRevocations
from gdp.rib.route import Route, Withdrawn
from gdp.rib.store import Store
from gdp.rib.upstream_advertisements import PROBE_S, Passed, UpstreamAdvertisements
from gdp.rib.upstream_queries import WATCH_AGAIN_S, UpstreamQueries
from gdp.rib.watches import Asker, Watches
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import Advertisement, UnverifiedAdvertisement
from gdp.trust.audit import Action
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from gdp.trust.verifier import AdvertisementVerifier
from gdp.trust.withdrawal import Withdrawal

__all__ = ["OutgoingStatement", "RibCore", "RibSettings"]

_ADVISED_S: Final = 30.0  # how long members that received a response also receive moves
_ROUTES_SHOWN: Final = 32  # of a name, in a diagnosis
_UNREPORTED_S: Final = 1.0  # ... where there are too many for that
_NAMES_OF_ISSUER_MAX: Final = 256  # names whose watchers receive a revocation by an issuer that is not the names' owner
_QUESTION_BYTES: Final = 1_024  # cost of a query, forwarded upstream or answered in the negative
_ANSWER_BYTES: Final = 1_024  # cost of a response without the advertisement in it
_STALE_MARGIN_S: Final = 1.0  # for the notice of a longer lease to arrive before the former one ends
_DOUBT_S: Final = 0.1  # a RIB above that is silent for so long receives a probe with the next query


class OutgoingStatement(NamedTuple):
    """A statement to send to a name."""

    to: Name
    kind: Kind
    statement: bytes
    about: Key | None = None  # the stored entry that it reports: not sent if the store did not accept that


@dataclass(frozen=True, slots=True, kw_only=True)
class RibSettings:
    """Options of an operator.

    Args:
        upper: RIBs of the tier above, any of which may be used, the preferred one first; after them RIBs of the tier
            above that, which are used while none of the former responds. Empty at the top.
        peers: other RIBs of this domain, with which this one replicates.
    """

    upper: tuple[Name, ...] = ()
    peers: tuple[Name, ...] = ()
    allow_unowned: bool = False
    names_per_sender: int = RIB_NAMES_PER_SENDER
    watches: int = RIB_WATCHES_MAX
    lease_max_s: float = LEASE_MAX_S


class RibCore:
    """Sans-I/O core of one RIB."""

    def __init__(self, identity: Identity, policy: Policy, store: Store, settings: RibSettings) -> None:
        self._identity = identity
        self._audit = policy.audit
        self._policy = policy
        self._store = store
        self._settings = settings
        self._verifier = AdvertisementVerifier(policy, allow_unowned=settings.allow_unowned)
        self._watches = Watches(settings.watches)
        self._revocations = RibRevocations(
            self._verifier, store, lambda name: bool(self._watches.watchers(name, self._now_s))
        )
        self._holders = Watches(settings.watches)  # members that received a response, for its lease
        self._upstream_queries = UpstreamQueries(is_top=not settings.upper)
        self._upstream = UpstreamAdvertisements(settings.upper)
        self._lower = LowerRibs()
        self._endpoints = RibEndpoints(
            identity, policy, lambda name: self._replication.push(ENDPOINTS, name), settings.watches
        )
        self._sets = {ENDPOINTS: self._endpoints.records} | ({} if store.digests is None else {ROUTES: store.digests})
        self._replication = Replication(identity, self._sets, self._item_of, settings.peers)
        self._answer_paces = TokenBuckets(ANSWER_BYTES_PER_S, ANSWER_BYTES_BURST)
        self._now_s = 0.0  # of the last call
        self._outgoing_statements: list[OutgoingStatement] = []
        self.boundary = ErrorBoundary()
        self.identities = IdentityChecks()
        self._former = FormerAdvertisers()
        self.refusals: Counter[DropReason] = Counter()
        self.accepted = 0
        self.answers = 0
        self.negative_answers = 0
        self.unknown_answers = 0

    @property
    def names(self) -> int:
        """Return how many routes are stored."""
        return len(self._store)

    @property
    def watching(self) -> int:
        """Return the number of watches."""
        return len(self._watches)

    def routes_of(self, name: Name, now: Timestamps) -> list[tuple[Route, Advertisement]]:
        """Return the routes of a name with their advertisements, each verified; invalid ones by now are left out.

        Raises:
            StoreError: the store does not answer.
        """
        self._store.prefetch([name], now)
        found = list[tuple[Route, Advertisement]]()
        for route in self._store.routes(name):
            with suppress(StatementError):
                found.append((route, self._verifier.verify_statement(parse(route.advertisement), now.unix_s)))
        return found

    def receive(self, wire: bytes, sender: Name, now: Timestamps) -> None:
        """Handle a statement from ``sender`` (from the frame header; unproven). Each invalid statement is counted."""
        self._now_s = now.mono_s
        try:
            statement = parse(wire)
            if statement.signer != sender:
                raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
            if statement.type is StatementType.RELAY:
                self._take_relay(statement, now)
            elif statement.type is StatementType.QUERY:
                self._handle_query(statement, now)
            elif statement.type is StatementType.ANSWER:
                self._take_answer_from_above(statement, now)
            elif statement.type is StatementType.ADVERTISE_ACK:
                self._take_ack_from_above(statement, now)
            elif statement.type is StatementType.PRESENCE:
                self._take_presence(statement, now)
            elif statement.type is StatementType.SYNC:
                self._take_sync(statement, now)
            elif statement.type is StatementType.ENDPOINTS:
                self._endpoints.receive_record(statement, now)
            else:
                raise StatementError(DropReason.MALFORMED, f"a RIB takes no {statement.type.value}")
        except RemoteError as error:
            self.refusals[error.reason] += 1
        except StoreError:
            self.refusals[DropReason.UNAVAILABLE] += 1  # no response: the sender will try again
        except Exception as error:  # one statement must not stop the RIB
            self.boundary.record(error)
            self.refusals[DropReason.INTERNAL] += 1

    def name_facts(self, name: Name, now: Timestamps) -> RibFacts:
        """Return what this RIB knows about a name, for a diagnosis. Raises ``StoreError``: the store is away."""
        routes = [route for route in self._store.routes(name) if route.expires_s > now.mono_s]
        return RibFacts(
            name=self._identity.name.to_text(),
            domain=self._identity.member.domain.to_text(),
            unix_s=now.unix_s,
            routes=tuple(
                RouteFact(
                    advertiser=route.advertiser.to_text(),
                    right=UnverifiedAdvertisement.from_statement(parse(route.advertisement)).right.value,
                    switch=route.switch.to_text(),
                    domain=route.domain.to_text(),
                    lease_s=round(route.expires_s - now.mono_s, 1),
                )
                for route in routes[:_ROUTES_SHOWN]
            ),
            gone=self._former.gone(name),
            refused=self._former.refused(name),
        )

    def waits(self, now_s: float) -> list[Wait]:
        """Return what this RIB waits for."""
        return [Wait(WaitReason.NO_UPPER_RIB, name=self._upstream.rib)] if self._upstream.is_silent(now_s) else []

    def parties(self, name: Name, now_s: float) -> set[Name]:
        """Return the nodes that advertise a name, and the switches and RIBs that watch it."""
        watchers = {asker.name for asker in self._watches.watchers(name, now_s)}
        return watchers | {route.advertiser for route in self._store.routes(name)}

    def receive_all(self, wires: Sequence[tuple[bytes, Name]], now: Timestamps) -> None:
        """Handle statements, each with its sender; the entries that they concern are read from the store in one go."""
        if self._store.digests is None:
            self._store.prefetch([name for wire, _ in wires if (name := _name_in(wire)) is not None], now)
        for wire, sender in wires:
            self.receive(wire, sender, now)

    def changed(self, names: Iterable[tuple[Name, list[Route]]], now: Timestamps) -> None:
        """Send watchers what another RIB changed in a shared store, given the routes that were known before."""
        self._now_s = now.mono_s
        concerned = [(name, before) for name, before in names if self._concerns(name, now.mono_s)]
        self._store.prefetch([name for name, _ in concerned], now)
        for name, before in concerned:
            try:
                routes = {route.advertiser: route for route in self._store.routes(name)}
            except StoreError:
                self.refusals[DropReason.UNAVAILABLE] += 1
                continue
            known = {route.advertiser: route for route in before}
            for advertiser, route in routes.items():
                self._tell(route, known.get(advertiser), now.mono_s, self._upstream_queries.answered(name, now.mono_s))
            for advertiser in known.keys() - routes.keys():
                self._tell_gone(known[advertiser], now.mono_s)

    def load(self, entries: Iterable[Entry], now: Timestamps) -> int:
        """Load entries of a snapshot, each verified; return how many are live. Each invalid entry is counted."""
        before = self.names
        for entry in entries:
            try:
                self._handle_entry(entry, now)
            except StatementError as error:
                self.refusals[error.reason] += 1
        return self.names - before

    def revoke(self, wire: bytes, origin: Name, now: Timestamps) -> None:
        """Revoke a certificate: routes that depend on it are removed, and every affected node receives the revocation.

        An invalid revocation is counted.

        Args:
            origin: the neighbour that it came over.
        """
        self._now_s = now.mono_s
        try:
            self._handle_revocation(parse(wire), origin, now)
        except RemoteError as error:
            self.refusals[error.reason] += 1
        except StoreError:
            self.refusals[DropReason.UNAVAILABLE] += 1

    def handle_timer(self, now: Timestamps) -> None:
        """Expire routes and notify their watchers; repeat open queries upstream."""
        for route in self._store.expire(now.mono_s, now.unix_s):
            if not self._keep_of_silent_rib(route, now):
                self._former.note_gone(route, is_lapsed=True)
                self._tell_gone(route, now.mono_s)
        self._now_s = now.mono_s
        self._watches.expire(now.mono_s)
        self._holders.expire(now.mono_s)
        self._replication.handle_timer(now.mono_s)
        self._endpoints.handle_timer(now)
        self._ask_what_is_due(now)
        for passed in self._upstream.due(now.mono_s):
            self._send_up(passed)

    def connected(self, now: Timestamps) -> None:
        """Record that statements arrive from now on: there is a switch."""
        self._now_s = now.mono_s
        self._replication.connected(now.mono_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._store.next_expiry(), self._upstream_queries.next_due(), self._upstream.next_due()]
        times += [self._replication.get_timer(), self._endpoints.get_timer()]
        return min((time for time in times if time is not None), default=None)

    def statements_to_send(self) -> list[OutgoingStatement]:
        """Return, once, the statements to send."""
        if refused := set(self._store.commit()):
            self._outgoing_statements = [
                outgoing for outgoing in self._outgoing_statements if outgoing.about not in refused
            ]
        letters, self._outgoing_statements = self._outgoing_statements, []
        letters += [
            OutgoingStatement(to, Kind.RIB_REQUEST, wire)
            for to, wire in self._replication.statements_to_send(self._now_s)
        ]
        return letters + [OutgoingStatement(*each) for each in self._endpoints.poll_statements()]

    # -- advertisements

    def _take_relay(self, statement: Statement, now: Timestamps) -> None:
        relayed = RelayedStatement.from_fields(statement.fields)
        member = self._policy.verify_sender(statement, now.unix_s, relayed.membership)
        if not (member.role.is_switch or member.role is Role.RIB):
            raise StatementError(DropReason.WRONG_DOMAIN, "relays are switches or RIBs")
        statement.verify(member.key)
        self._lower.record_alive(member.name, now.mono_s)
        passed_on = parse(relayed.statement)
        if passed_on.type is StatementType.REVOKE:
            self._handle_revocation(passed_on, member.name, now)
            return
        if passed_on.type is StatementType.WITHDRAW:
            self._take_withdrawal(passed_on, member, now)
            return
        try:
            advertisement = self._verifier.verify_statement(passed_on, now.unix_s)
            if member.role.is_switch and advertisement.switch != member.name:
                raise StatementError(DropReason.NOT_DELEGATED, "the RtCert names another switch than the relay")
            if relayed.domain is not None and not self._policy.trusts(relayed.domain):
                raise StatementError(DropReason.WRONG_DOMAIN, "an advertisement of a domain that is not trusted")
            if member.domain != self._policy.own and not advertisement.is_global:
                raise StatementError(DropReason.WRONG_DOMAIN, "a local name of another domain")
            self._check_identity(advertisement, now)
            if advertisement.right is Right.ATTACH and self.identities.is_refused_above(
                advertisement.node, advertisement.incarnation, now.mono_s
            ):
                route = self._route(advertisement, relayed.transit, member, now)
                self._forward_upstream(route, relayed.statement, route.sequence, now.mono_s)
                raise StatementError(DropReason.IN_USE, "another node with this identity, says the tier above")
            known = self._check_news(advertisement, member)
        except StatementError as error:
            self._refuse(passed_on, member, error, now.mono_s)
            raise
        route = self._route(advertisement, relayed.transit, member, now)
        if relayed.domain is not None and member.role is Role.RIB:
            route = replace(route, domain=relayed.domain)
        self._store.put(route)
        self._former.note_accepted(route)
        self.accepted += 1
        if not isinstance(known, Route):
            self._audit.record(Action.ACCEPTED, "name", who=route.advertiser.to_text(), about=route.name.to_text())
        self._acknowledge(route.name, route.advertiser, None, route.sequence, member.name)
        self._tell(route, known, now.mono_s)
        self._replicate(route.name, route.advertiser)
        if advertisement.is_global and not self._upstream.has(member.name):
            self._forward_upstream(route, relayed.statement, route.sequence, now.mono_s)

    def _check_identity(self, advertisement: Advertisement, now: Timestamps) -> None:
        """Reject a node's own name in another incarnation while the older node lives at another switch.

        Raises:
            StatementError: IN_USE; the older node's switch has received a presence question.
        """
        held = self._store.get(advertisement.name, advertisement.node) if advertisement.right is Right.ATTACH else None
        if not isinstance(held, Route) or held.switch == advertisement.switch:
            return
        older = UnverifiedAdvertisement.from_statement(parse(held.advertisement)).incarnation
        if older == advertisement.incarnation or self.identities.is_free(
            advertisement.node, older, held.switch, now.mono_s
        ):
            return
        number = int(now.unix_s * 1_000)
        if self.identities.must_ask(advertisement.node, older, held.switch, number, now.mono_s):
            question = Presence(node=advertisement.node, incarnation=older, other=advertisement.switch, question=number)
            wire = question.to_wire(self._identity.name, self._identity.key, self._identity.membership)
            self._outgoing_statements.append(OutgoingStatement(held.switch, Kind.RIB_ANSWER, wire))
        raise StatementError(DropReason.IN_USE, "another node with this identity")

    def _take_presence(self, statement: Statement, now: Timestamps) -> None:
        member = self._policy.verify_sender(statement, now.unix_s)
        statement.verify(member.key)
        presence = Presence.from_fields(statement.fields)
        if presence.is_answer:
            self.identities.answered(presence, member.name, now.mono_s)

    def _check_news(self, advertisement: Advertisement, member: Membership) -> Route | Withdrawn | None:
        """Return what was known before of an advertisement that may be accepted.

        Raises:
            StatementError: STALE, LEASE_BOUNDS or QUOTA.
        """
        if advertisement.lease_s > self._settings.lease_max_s:
            raise StatementError(DropReason.LEASE_BOUNDS)
        known = self._store.get(advertisement.name, advertisement.node)
        if known is not None and advertisement.sequence <= known.sequence:
            is_repeated = isinstance(known, Route) and (known.advertisement, known.via) == (
                advertisement.wire,
                member.domain,
            )
            if not is_repeated:
                raise StatementError(DropReason.STALE, str(known.sequence))
        if known is None or known.sender != member.name:
            self._check_quota(member.name, advertisement.node)
        return known

    def _check_quota(self, sender: Name, node: Name) -> None:
        """Return if sender and node may have another name; a node gets at most as many as the sender has left.

        Raises:
            StatementError: QUOTA.
        """
        free = self._settings.names_per_sender - self._store.count_of(sender)
        if free <= 0:
            raise StatementError(DropReason.QUOTA, "names of one sender")
        if self._store.count_of(node) >= free:
            raise StatementError(DropReason.QUOTA, "names of one node")

    def _route(
        self, advertisement: Advertisement, transit: tuple[Name, ...], member: Membership, now: Timestamps
    ) -> Route:
        left_s = max(advertisement.valid_until_unix_s - now.unix_s, 1.0)
        return Route.of(
            advertisement,
            sender=member.name,
            domain=member.domain,
            via=member.domain,
            transit=tuple(sorted(self._policy.transit)) if self._is_own_switch(member) else transit,
            expires_s=now.mono_s + min(advertisement.lease_s, left_s),
        )

    def _take_withdrawal(self, statement: Statement, member: Membership, now: Timestamps) -> None:
        withdrawal = Withdrawal.received(statement, now.unix_s)
        name, advertiser, sequence = withdrawal.name, statement.signer, withdrawal.sequence
        known = self._store.get(name, advertiser)
        if not isinstance(known, Route) or sequence < known.sequence:
            raise StatementError(DropReason.STALE, "nothing to withdraw")
        pending_advertisement = UnverifiedAdvertisement.from_statement(parse(known.advertisement))
        statement.verify(self._policy.verify_membership(pending_advertisement.membership, now.unix_s).key)
        self._withdraw(known, sequence, statement.wire, pending_advertisement.membership)
        self._acknowledge(name, advertiser, None, sequence, member.name)
        self._tell_gone(known, now.mono_s, by=member.name)
        self._replicate(name, advertiser)
        if known.is_global and not self._upstream.has(member.name):
            self._forward_upstream(known, statement.wire, sequence, now.mono_s)

    def _withdraw(self, route: Route, sequence: int, proof: bytes, membership: bytes) -> None:
        gone = Withdrawn(route.sender, max(sequence, route.sequence), route.valid_until_unix_s, proof, membership)
        self._store.withdraw(route.name, route.advertiser, gone)
        self._former.note_gone(route, is_lapsed=False)

    def _forward_upstream(self, route: Route, statement: bytes, sequence: int, now_s: float) -> None:
        if self._upstream.rib is not None:
            key = (route.name, route.advertiser)
            passed = Passed(
                key=key,
                sequence=sequence,
                statement=statement,
                domain=route.domain,
                transit=route.transit,
                until_s=route.expires_s,
            )
            self._upstream.put(passed, now_s)
            for passed in self._upstream.due(now_s):
                self._send_up(passed)

    def _send_up(self, passed: Passed) -> None:
        upper = self._upstream.rib
        assert upper is not None
        relayed = RelayedStatement(passed.statement, passed.transit, self._identity.membership, passed.domain)
        self._outgoing_statements.append(
            OutgoingStatement(upper, Kind.RIB_REQUEST, relayed.to_wire(self._identity.name, self._identity.key))
        )

    def _refuse(self, passed_on: Statement, member: Membership, error: StatementError, now_s: float) -> None:
        """Send a proven relay a rejecting AdvertiseAck, with the advertiser's present location if it has moved."""
        try:
            name = UnverifiedAdvertisement.from_statement(passed_on).subject.name
        except StatementError:
            return  # not even an advertisement: a response could name nothing; the caller counts it
        self._former.note_refused(name, error.reason)
        who, reason = passed_on.signer.to_text(), error.reason.label
        self._audit.record(Action.REFUSED, "name", who=who, about=name.to_text(), reason=reason)
        known = self._store.get(name, passed_on.signer)
        if error.reason is DropReason.REVOKED:
            self._send_revocations(self._revocations.behind(_revocable(passed_on)), [member.name])
        self._acknowledge(name, passed_on.signer, error.reason, 0 if known is None else known.sequence, member.name)
        has_moved = error.reason is DropReason.STALE and isinstance(known, Route) and known.sender != member.name
        if has_moved and isinstance(known, Route) and self._may_tell(known, _asker(member)):
            self._answer(known, _asker(member), now_s)

    def _acknowledge(self, name: Name, advertiser: Name, refused: DropReason | None, sequence: int, to: Name) -> None:
        ack = AdvertiseAck(name, advertiser, refused, sequence)
        wire = ack.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        about = (name, advertiser) if refused is None else None
        self._outgoing_statements.append(OutgoingStatement(to, Kind.RIB_ANSWER, wire, about))

    # -- queries

    def _handle_query(self, statement: Statement, now: Timestamps) -> None:
        fields = statement.fields
        member = self._policy.verify_sender(statement, now.unix_s)
        if not (member.role.is_switch or member.role is Role.RIB):
            raise StatementError(DropReason.NOT_DELEGATED, "only switches and RIBs ask")
        statement.verify(member.key)
        self._lower.record_alive(member.name, now.mono_s)
        query = Query.from_fields(fields)
        if query.name == self._identity.name:
            self._deny(query.name, member.name)  # a probe for a sign of life
            return
        asker = _asker(member)
        routes = [route for route in self._store.routes(query.name) if self._may_tell(route, asker)]
        cost = _QUESTION_BYTES + sum(len(route.advertisement) + _ANSWER_BYTES for route in routes)
        if not self._answer_paces.spend(member.name, now.mono_s, cost):
            raise StatementError(DropReason.QUOTA, "answers to one asker")
        if query.watch_s > 0:
            self._watch(query, asker, now.mono_s)
        if query.revoked is not None:
            lacked = self._revocations.lacked_by(member.name, query.name, query.revoked, now.mono_s)
            self._send_revocations(lacked, [member.name])
        for route in routes:
            self._answer(route, asker, now.mono_s)
        is_below = not self._upstream.has(member.name)
        if is_below and self._upstream_queries.request(
            query.name, asker, query.watch_s, now.mono_s, is_known=bool(routes)
        ):
            self._ask_upstream(query.name, self._upstream_queries.watch_s(query.name))
        elif not routes and not self._upstream_queries.is_waiting(query.name):
            self._answer_none(query.name, member.name, is_unknown=bool(self._settings.upper))

    def _watch(self, query: Query, asker: Asker, now_s: float) -> None:
        """Add a watch for an asker; above the watch limit it still gets a response, and will send its query again."""
        try:
            self._watches.add(query.name, asker, now_s + query.watch_s)
        except StatementError as error:
            self.refusals[error.reason] += 1

    def _may_tell(self, route: Route, asker: Asker) -> bool:
        """Return whether an asker may receive a route.

        A local name stays in its domain. A RIB below does not receive what its own domain advertised.
        """
        if asker.domain == self._policy.own:
            return True
        return route.is_global and not (asker.is_rib and asker.domain in (route.domain, route.via))

    def _answer(self, route: Route, to: Asker, now_s: float) -> None:
        lease_s = min(max(route.expires_s - now_s, 0.0), _ADVISED_S)
        try:
            self._holders.add(route.name, to, now_s + lease_s)
        except StatementError:
            lease_s = min(lease_s, _UNREPORTED_S)
        response = Response(
            name=route.name,
            advertiser=route.advertiser,
            advertisement=route.advertisement,
            domain=route.domain,
            transit=route.transit,
            lease_s=lease_s,
        )
        self.answers += 1
        self._send(response, to.name, (route.name, route.advertiser))

    def _answer_none(self, name: Name, to: Name, *, is_unknown: bool) -> None:
        """Answer that no node advertises a name, or, if the tier above could not be asked, that it is not known."""
        if self._replication.is_cold(self._now_s):
            return  # a peer may know; the asker repeats its query, here or at that peer
        self._deny(name, to, lease_s=0.0 if is_unknown else NEGATIVE_LEASE_S)

    def _deny(self, name: Name, to: Name, lease_s: float = NEGATIVE_LEASE_S) -> None:
        if lease_s > 0.0:
            self.negative_answers += 1
        else:
            self.unknown_answers += 1
        own = self._policy.own
        self._send(Response(name=name, advertiser=name, advertisement=b"", domain=own, transit=(), lease_s=lease_s), to)

    def _send(self, response: Response, to: Name, about: Key | None = None) -> None:
        wire = response.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._outgoing_statements.append(OutgoingStatement(to, Kind.RIB_ANSWER, wire, about))

    def _concerns(self, name: Name, now_s: float) -> bool:
        """Return whether any node is to be notified of a name."""
        is_held = self._watches.watchers(name, now_s) or self._holders.watchers(name, now_s)
        return bool(is_held) or self._upstream_queries.is_waiting(name)

    def _tell(self, route: Route, known: Route | Withdrawn | None, now_s: float, askers: Sequence[Asker] = ()) -> None:
        """Send a route to ``askers``, to watchers, and after a move to holders and the sender of the old location."""
        recipients = dict.fromkeys((*askers, *self._watches.watchers(route.name, now_s)))
        if isinstance(known, Route) and known.place != route.place:
            recipients |= dict.fromkeys(self._holders.watchers(route.name, now_s))
            if known.sender != route.sender:
                recipients |= self._sender_of(known)
        for asker in recipients:
            if self._may_tell(route, asker):
                self._answer(route, asker, now_s)

    def _sender_of(self, route: Route) -> dict[Asker, None]:
        """Return the relay of a route, unless that was the tier above."""
        is_rib = route.sender != route.switch
        return {} if route.is_from_upstream else {Asker(route.sender, route.via, is_rib): None}

    def _tell_gone(self, route: Route, now_s: float, by: Name | None = None) -> None:
        """Notify a name's watchers, holders and sender that a route is gone, except ``by``, which knows."""
        recipients = dict.fromkeys(
            (*self._watches.watchers(route.name, now_s), *self._holders.watchers(route.name, now_s))
        )
        if by not in (None, route.sender):
            recipients |= self._sender_of(route)
        for asker in recipients:
            if self._may_tell(route, asker):
                gone = Response(
                    name=route.name,
                    advertiser=route.advertiser,
                    advertisement=b"",
                    domain=route.domain,
                    transit=(),
                    lease_s=0.0,
                    sequence=route.sequence,
                )
                self._send(gone, asker.name)

    # -- the tier above

    def _ask_what_is_due(self, now: Timestamps) -> None:
        """Repeat queries to the tier above; of several RIBs there, replace a silent one."""
        now_s = now.mono_s
        if self._upstream.turn_over(now_s):
            self._upstream_queries.ask_again(now_s)
        ask, given_up = self._upstream_queries.due(now_s, is_silent=self._upstream.is_silent(now_s))
        for query in ask:
            if query.is_unanswered:
                self._serve_stale(query.name, query.again_s, now)
            self._ask_upstream(query.name, query.watch_s)
        for name, askers in given_up:
            for asker in askers:
                self._answer_none(name, asker.name, is_unknown=True)
        for rib in self._upstream.preferred(now_s):
            self._query_upstream(rib, rib, 0.0)
        self._probe(now_s, PROBE_S)

    def _serve_stale(self, name: Name, until_s: float, now: Timestamps) -> None:
        """Keep the routes that the tier above gave until it is asked next, as it does not respond (as in RFC 8767).

        The proofs of an advertisement still end it.
        """
        try:
            routes = self._store.routes(name)
        except StoreError:
            self.refusals[DropReason.UNAVAILABLE] += 1  # a shared store that is away, too, keeps its routes itself
            return
        for route in routes:
            is_lapsing = route.expires_s < until_s + _STALE_MARGIN_S
            if route.is_from_upstream and is_lapsing and now.unix_s < route.valid_until_unix_s:
                self._keep(route, max(until_s, now.mono_s + WATCH_AGAIN_S), now.mono_s)

    def _keep_of_silent_rib(self, route: Route, now: Timestamps) -> bool:
        """Keep a route whose lease ended if the RIB below that relayed it is silent; return whether that is so."""
        if route.is_from_upstream or route.sender == route.switch or now.unix_s >= route.valid_until_unix_s:
            return False
        keep_s = self._lower.keep_s(route.sender, now.mono_s)
        if keep_s == 0.0:
            return False
        self._keep(route, now.mono_s + keep_s, now.mono_s)
        if self._lower.is_probe_due(route.sender, now.mono_s):
            self._send_query(route.sender, Query(route.sender, 0.0))
        return True

    def _keep(self, route: Route, until_s: float, now_s: float) -> None:
        """Keep a route beyond its lease, and notify those that it concerns."""
        stale = replace(route, expires_s=until_s + _STALE_MARGIN_S)
        self._store.put(stale)
        self._tell(stale, route, now_s)

    def _probe(self, now_s: float, quiet_s: float) -> None:
        """Send one of several RIBs above a probe if it gave no sign of life for ``quiet_s``."""
        if self._upstream.probe(now_s, quiet_s):
            self._query_upstream(self._upstream.rib, self._upstream.rib, 0.0)

    def _ask_upstream(self, name: Name, watch_s: float) -> None:
        self._query_upstream(self._upstream.rib, name, watch_s)
        self._probe(self._now_s, _DOUBT_S)

    def _query_upstream(self, upper: Name | None, name: Name | None, watch_s: float) -> None:
        assert upper is not None
        assert name is not None
        self._upstream.record_asked(self._now_s)
        self._send_query(upper, Query(name, watch_s, self._policy.revoked.digest_about(name) if watch_s > 0 else None))

    def _send_query(self, to: Name, query: Query) -> None:
        wire = query.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._outgoing_statements.append(OutgoingStatement(to, Kind.RIB_REQUEST, wire))

    def _upper_member(self, statement: Statement, now: Timestamps) -> Membership:
        """Return the signer of a statement from the tier above. Raises ``StatementError``: it is not from there."""
        member = self._policy.verify_sender(statement, now.unix_s)
        if not self._upstream.has(member.name) or member.role is not Role.RIB:
            raise StatementError(DropReason.WRONG_DOMAIN, "not from the tier above")
        statement.verify(member.key)
        if self._upstream.record_alive(member.name, now.mono_s):
            self._upstream_queries.ask_again(now.mono_s)
        return member

    def _take_ack_from_above(self, statement: Statement, now: Timestamps) -> None:
        self._upper_member(statement, now)
        ack = AdvertiseAck.from_fields(statement.fields)
        key = ack.name, ack.advertiser
        if ack.refused in (None, DropReason.STALE):
            self._upstream.handle_ack(key, ack.sequence)
            self.identities.taken_above(ack.name)
            return
        self._upstream.refused(key)
        known = self._store.get(*key)
        if ack.refused is DropReason.IN_USE and isinstance(known, Route) and not known.is_from_upstream:
            incarnation = UnverifiedAdvertisement.from_statement(parse(known.advertisement)).incarnation
            self.identities.refused_above(ack.name, incarnation, now.mono_s)
            self._store.withdraw(*key)
            self._tell_gone(known, now.mono_s)
            self._acknowledge(*key, DropReason.IN_USE, known.sequence, known.sender)

    def _take_answer_from_above(self, statement: Statement, now: Timestamps) -> None:
        fields = statement.fields
        response = Response.from_fields(fields)
        if response.name == statement.signer and not self._upstream.has(statement.signer):
            self._take_sign_of_life(statement, now)
            return
        member = self._upper_member(statement, now)
        if response.is_negative or response.is_unknown:
            record = self._upstream_queries.not_known if response.is_unknown else self._upstream_queries.answered
            askers = record(response.name, now.mono_s)
            if response.is_unknown:
                self._serve_stale(response.name, now.mono_s + WATCH_AGAIN_S, now)
            if not self._store.routes(response.name):
                for asker in askers:
                    self._answer_none(response.name, asker.name, is_unknown=response.is_unknown)
            return
        known = self._store.get(response.name, response.advertiser)
        if not response.advertisement:
            if isinstance(known, Route) and known.is_from_upstream and known.sequence <= response.sequence:
                self._store.withdraw(response.name, response.advertiser)
                self._tell_gone(known, now.mono_s)
            return
        self._learn_from_upstream(response, member, known, now)

    def _take_sign_of_life(self, statement: Statement, now: Timestamps) -> None:
        """Take the answer of a RIB below to a probe."""
        member = self._policy.verify_sender(statement, now.unix_s)
        statement.verify(member.key)
        self._lower.record_alive(member.name, now.mono_s)

    def _learn_from_upstream(
        self, response: Response, member: Membership, known: Route | Withdrawn | None, now: Timestamps
    ) -> None:
        advertisement = self._verifier.verify(response.advertisement, now.unix_s)
        if advertisement.name != response.name or advertisement.node != response.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "an answer about something else than its advertisement")
        is_from_below = (
            isinstance(known, Route) and not known.is_from_upstream and known.advertisement == advertisement.wire
        )
        if response.domain == self._policy.own or is_from_below:
            return  # our own, or of a tier below, returned from above
        if isinstance(known, Route) and advertisement.sequence < known.sequence:
            raise StatementError(DropReason.STALE, "the tier above is behind")
        route = replace(
            self._route(advertisement, response.transit, member, now),
            domain=response.domain,
            is_from_upstream=True,
            expires_s=now.mono_s + response.lease_s,
        )
        self._store.put(route)
        if isinstance(known, Route) and not known.is_from_upstream:
            self._replicate(route.name, route.advertiser)  # a peer has the old location
        askers = self._upstream_queries.answered(response.name, now.mono_s, response.lease_s)
        self._tell(route, known, now.mono_s, askers)

    # -- revocations

    def _handle_revocation(self, statement: Statement, origin: Name, now: Timestamps) -> None:
        """Handle a revocation from a neighbour or a relay.

        Raises:
            StatementError: it is not valid, concerns nothing here, or exceeds a quota.
            StoreError: a shared store did not respond.
        """
        try:
            revocation = self._revocations.receive_revocation(statement, origin, now)
        except StatementError as error:
            if error.reason is DropReason.UNCONCERNED:
                self._pass_revocation_up(statement, origin, now)
            raise
        if revocation is None:
            self._pass_revocation_up(statement, origin, now)  # it is repeated for those that lacked it
            return
        self._endpoints.recheck(now)
        who, about = revocation.issuer.name.to_text(), revocation.fingerprint.hex()
        self._audit.record(Action.REVOKED, "certificate", who=who, about=about)
        recipients: dict[Asker, None] = {}
        closed = self._revocations.closed(revocation, now)
        # switches flood revocations of roots everywhere
        if not self._policy.revoked.is_root(revocation.issuer.owner_key):
            for name in dict.fromkeys((revocation.issuer.name, *(route.name for route in closed))):
                recipients |= self._concerned_by(name, now.mono_s)
            if not recipients:  # the issuer signs in its own name: an owner's successor, or a delegate
                others = self._store.resting_on(revocation.issuer.owner_key)
                for name in list(dict.fromkeys(route.name for route in others))[:_NAMES_OF_ISSUER_MAX]:
                    recipients |= self._concerned_by(name, now.mono_s)
            ribs = self._upstream_and_peers(origin)
            self._send_revocations([statement.wire], ribs, Kind.RIB_REQUEST)
            self._send_revocations(
                [statement.wire], [each.name for each in recipients if each.name not in (origin, *ribs)]
            )
        for route in closed:
            self._store.withdraw(route.name, route.advertiser)
            self._tell_gone(route, now.mono_s)

    def _pass_revocation_up(self, statement: Statement, sender: Name, now: Timestamps) -> None:
        """Forward a revocation that changes nothing here to the tier above, if that is allowed."""
        upper = self._upstream.rib
        is_root = self._policy.revoked.is_root(Revocation.read(statement).issuer.owner_key)
        if upper is None or is_root or self._upstream.has(sender) or sender in self._settings.peers:
            return
        if self._revocations.may_pass_up(statement, sender, now):
            self._send_revocations([statement.wire], [upper], Kind.RIB_REQUEST)

    def _concerned_by(self, name: Name, now_s: float) -> dict[Asker, None]:
        """Return the nodes that advertised, hold or watch a name."""
        recipients = dict.fromkeys((*self._watches.watchers(name, now_s), *self._holders.watchers(name, now_s)))
        for route in self._store.routes(name):
            recipients |= self._sender_of(route)
        return recipients

    def _upstream_and_peers(self, origin: Name) -> list[Name]:
        """Return the RIBs that receive every revocation: the tier above, and peers."""
        if self._upstream.has(origin):
            return list(self._settings.peers)
        upstream = [] if self._upstream.rib is None else [self._upstream.rib]
        return upstream if origin in self._settings.peers else [*upstream, *self._settings.peers]

    def _send_revocations(self, wires: Iterable[bytes], to: Iterable[Name], kind: Kind = Kind.RIB_ANSWER) -> None:
        names = list(to)
        for wire in wires if names else ():
            relay = RelayedStatement(wire, (), self._identity.membership).to_wire(
                self._identity.name, self._identity.key
            )
            self._outgoing_statements += [OutgoingStatement(name, kind, relay) for name in names]

    # -- endpoints of switches

    @property
    def endpoints(self) -> int:
        """Return how many endpoint records are kept."""
        return len(self._endpoints)

    # -- other RIBs of the domain

    def _replicate(self, name: Name, advertiser: Name) -> None:
        if ROUTES in self._sets:
            self._replication.push(ROUTES, name + advertiser)

    def _item_of(self, of: bytes, key: bytes, now_s: float) -> bytes | None:
        """Return an item as a peer gets it, or None."""
        if of == ENDPOINTS:
            return self._endpoints.item_of(Name(key), now_s)
        entry = self.entry_of((Name(key[:NAME_BYTES]), Name(key[NAME_BYTES:])), now_s)
        return None if entry is None else entry.to_cbor()

    def entry_of(self, key: Key, now_s: float) -> Entry | None:
        """Return the stored entry of an advertiser of a name, for a peer or a snapshot, or None."""
        known = self._store.get(*key)
        if isinstance(known, Route) and known.expires_s > now_s:
            lease_s = min(known.expires_s - now_s, LEASE_MAX_S)
            return Entry(
                statement=known.advertisement,
                membership=b"",
                sender=known.sender,
                domain=known.domain,
                via=known.via,
                transit=known.transit,
                lease_s=lease_s,
                is_from_upstream=known.is_from_upstream,
            )
        if isinstance(known, Withdrawn) and known.proof:
            return Entry(
                statement=known.proof,
                membership=known.membership,
                sender=known.sender,
                domain=self._policy.own,
                via=self._policy.own,
                transit=(),
                lease_s=0.0,
                is_from_upstream=False,
                until_unix_s=known.valid_until_unix_s,
            )
        return None

    def _take_sync(self, statement: Statement, now: Timestamps) -> None:
        """Take part in equalising a set with a RIB of this domain, or answer a switch that asks for endpoints."""
        member = self._policy.verify_sender(statement, now.unix_s)
        is_peer = member.role is Role.RIB and member.domain == self._policy.own
        if not is_peer and not member.role.is_switch:
            raise StatementError(DropReason.WRONG_DOMAIN, "replicates with RIBs of this domain only")
        statement.verify(member.key)
        message = SyncMessage.from_fields(statement.fields)
        if not is_peer:
            self._endpoints.handle_query(message, member, now)
            return
        if not self._replication.add_peer(member.name, now.mono_s):
            raise StatementError(DropReason.QUOTA, "peers")
        for item in self._replication.receive(message, member.name, now.mono_s):
            try:
                if message.of == ENDPOINTS:
                    self._endpoints.receive_item(item, now)
                elif message.of in self._sets:
                    self._handle_entry(Entry.from_cbor(item), now)
            except StatementError as error:
                self.refusals[error.reason] += 1

    def _handle_entry(self, entry: Entry, now: Timestamps) -> None:
        """Handle an entry of a peer as if it had arrived here.

        Raises:
            StatementError: it is not valid; an entry that is merely no news raises nothing.
        """
        statement = parse(entry.statement)
        if statement.type is StatementType.WITHDRAW:
            self._take_withdrawn_entry(entry, statement, now)
            return
        advertisement = self._verifier.verify_statement(statement, now.unix_s)
        known = self._store.get(advertisement.name, advertisement.node)
        lease_s = min(entry.lease_s, advertisement.lease_s, advertisement.valid_until_unix_s - now.unix_s)
        if lease_s <= 0 or advertisement.lease_s > self._settings.lease_max_s:
            raise StatementError(DropReason.LEASE_BOUNDS)
        if known is not None and not self._is_newer(advertisement, known, now.mono_s + lease_s):
            return
        if entry.is_from_upstream and (not isinstance(known, Route) or known.is_from_upstream):
            return  # no entry here that it corrects
        if known is None:
            self._check_quota(entry.sender, advertisement.node)
        route = Route.of(
            advertisement,
            sender=entry.sender,
            domain=entry.domain,
            via=entry.via,
            transit=entry.transit,
            expires_s=now.mono_s + lease_s,
            is_from_upstream=entry.is_from_upstream,
        )
        self._store.put(route)
        self._tell(route, known, now.mono_s, self._upstream_queries.answered(route.name, now.mono_s))

    def _is_newer(self, advertisement: Advertisement, known: Route | Withdrawn, expires_s: float) -> bool:
        """Return whether a peer's advertisement replaces the known one: a higher sequence, or the same for longer."""
        if advertisement.sequence != known.sequence:
            return advertisement.sequence > known.sequence
        is_same = isinstance(known, Route) and known.advertisement == advertisement.wire
        return is_same and isinstance(known, Route) and (known.is_from_upstream or expires_s > known.expires_s)

    def _take_withdrawn_entry(self, entry: Entry, statement: Statement, now: Timestamps) -> None:
        withdrawal = Withdrawal.received(statement, now.unix_s)
        name, sequence = withdrawal.name, withdrawal.sequence
        known = self._store.get(name, statement.signer)
        if known is not None and known.rank >= 2 * sequence + 1:
            return
        member = self._policy.verify_sender(statement, now.unix_s, entry.membership)
        statement.verify(member.key)
        until_unix_s = min(entry.until_unix_s, member.not_after_unix_s + int(CLOCK_SKEW_S))
        if known is not None:  # a peer must not shorten the lease of a known entry
            until_unix_s = max(until_unix_s, known.valid_until_unix_s)
        if until_unix_s <= now.unix_s:
            return  # expired here already
        if known is None:
            self._check_quota(entry.sender, statement.signer)
        gone = Withdrawn(entry.sender, sequence, until_unix_s, statement.wire, entry.membership)
        route = self._store.withdraw(name, statement.signer, gone)
        if route is not None:
            self._tell_gone(route, now.mono_s, by=entry.sender)

    def _is_own_switch(self, member: Membership) -> bool:
        return member.role.is_switch and member.domain == self._policy.own


def _name_in(wire: bytes) -> Name | None:
    """Return the name that a query or a relay is about, unverified; None for other statements."""
    try:
        statement = parse(wire)
        if statement.type is StatementType.RELAY:
            statement = parse(RelayedStatement.from_statement(statement).statement)
        return Keyed("name" if statement.type is StatementType.ADVERTISE else "n", NAME).read(statement.fields)
    except StatementError:
        return None


def _revocable(statement: Statement) -> list[tuple[bytes, bytes]]:
    """Return the unverified fingerprints in an advertisement's evidence, each with every key that may revoke it."""
    body = UnverifiedAdvertisement.from_statement(statement)
    found, issuer_key = [], body.subject.owner_key
    for wire in body.chain:
        link = AdCert.from_statement(parse(wire))
        found += [(link.fingerprint, key) for key in dict.fromkeys((body.subject.owner_key, issuer_key))]
        issuer_key = link.delegate_key
    return found


def _asker(member: Membership) -> Asker:
    return Asker(member.name, member.domain, member.role is Role.RIB)
