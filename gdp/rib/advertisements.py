"""Advertisements and withdrawals that a switch or a RIB relays, and the checks of a node's identity.

Sans-I/O. An advertisement is accepted only if the name's hash is right and the chain from the owner's key to the
advertiser is valid. The sequence number must be newer, the lease in bounds, and the quota not used up. Global names are
forwarded to the tier above.
"""

from __future__ import annotations

from dataclasses import replace

from gdp.control.presence import Presence
from gdp.control.rib_statements import AdvertiseAck, RelayedStatement
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.statements import Statement, parse
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.rib.revocations import send_revoking
from gdp.rib.route import Route, Withdrawn
from gdp.rib.state import ROUTES, RibCoreState
from gdp.rib.store import check_quota
from gdp.rib.upstream_advertisements import Passed
from gdp.rib.watches import Asker
from gdp.sansio import Timestamps
from gdp.trust.advertisement import Advertisement, UnverifiedAdvertisement, Withdrawal
from gdp.trust.audit import Action
from gdp.trust.right import Right


def receive_advertisement(
    state: RibCoreState, statement: Statement, relayed: RelayedStatement, member: Membership, now: Timestamps
) -> None:
    """Store an advertisement of a proven relay, which receives the result; notify those that it concerns."""
    try:
        advertisement, known = _verified(state, statement, relayed, member, now)
    except StatementError as error:
        _refuse(state, statement, member, error, now.mono_s)
        raise
    route = _route(state, advertisement, relayed, member, now)
    if relayed.domain is not None and member.role is Role.RIB:
        route = replace(route, domain=relayed.domain)
    state.store.put(route)
    state.accepted += 1
    if not isinstance(known, Route):
        who, about = route.advertiser.to_text(), route.name.to_text()
        state.policy.audit.record(Action.ACCEPTED, "name", who=who, about=about)
    key = route.key
    state.outbox.send_ack(key, None, route.sequence, member.name)
    if not _is_renewal(route, known):
        state.outbox.notify(route, known, now.mono_s)
    state.exchange.push(ROUTES, b"".join(key))
    if route.is_global and not state.upstream.has(member.name):
        _forward(state, route, statement, route.sequence, now.mono_s)


def receive_withdrawal(
    state: RibCoreState, statement: Statement, _relayed: RelayedStatement, member: Membership, now: Timestamps
) -> None:
    """Remove the route of an advertiser, which signed the withdrawal that a proven relay sent."""
    withdrawal = Withdrawal.received(statement, now.unix_s)
    key, sequence = (withdrawal.name, statement.signer), withdrawal.sequence
    known = state.store.get(*key)
    if not isinstance(known, Route) or sequence < known.sequence:
        raise StatementError(DropReason.STALE, "nothing to withdraw")
    membership = UnverifiedAdvertisement.from_statement(parse(known.advertisement)).membership
    statement.verify(state.policy.verify_membership(membership, now.unix_s).key)
    gone = Withdrawn(known.sender, sequence, known.valid_until_unix_s, statement.wire, membership)
    state.store.withdraw(*key, gone)
    state.former.note_gone(known, is_lapsed=False)
    state.outbox.send_ack(key, None, sequence, member.name)
    state.outbox.notify_gone(known, now.mono_s, by=member.name)
    state.exchange.push(ROUTES, b"".join(key))
    if known.is_global and not state.upstream.has(member.name):
        _forward(state, known, statement, sequence, now.mono_s)


def receive_ack(state: RibCoreState, statement: Statement, now: Timestamps) -> None:
    """Handle an AdvertiseAck of the tier above."""
    state.verify_upper(statement, now)
    ack = AdvertiseAck.from_fields(statement.fields)
    key = ack.name, ack.advertiser
    if ack.refused in (None, DropReason.STALE):
        state.upstream.handle_ack(key, ack.sequence)
        state.identities.taken_above(ack.name)
        return
    state.upstream.remove(key)
    known = state.store.get(*key)
    if ack.refused is DropReason.IN_USE and isinstance(known, Route) and not known.is_from_upstream:
        incarnation = UnverifiedAdvertisement.from_statement(parse(known.advertisement)).incarnation
        state.identities.refused_above(ack.name, incarnation, now.mono_s)
        state.store.withdraw(*key)
        state.outbox.notify_gone(known, now.mono_s)
        state.outbox.send_ack(key, DropReason.IN_USE, known.sequence, known.sender)


def receive_presence(state: RibCoreState, statement: Statement, now: Timestamps) -> None:
    """Handle a switch's response to a presence question."""
    member = state.policy.verify_sender(statement, now.unix_s)
    statement.verify(member.key)
    presence = Presence.from_fields(statement.fields)
    if presence.is_answer:
        state.identities.answered(presence, member.name, now.mono_s)


def _verified(
    state: RibCoreState, statement: Statement, relayed: RelayedStatement, member: Membership, now: Timestamps
) -> tuple[Advertisement, Route | Withdrawn | None]:
    """Return an advertisement that may be accepted, and what was known of it before.

    Raises:
        StatementError: it is refused.
    """
    advertisement = state.verifier.verify_statement(statement, now.unix_s)
    if member.role.is_switch and advertisement.switch != member.name:
        raise StatementError(DropReason.NOT_DELEGATED, "the RtCert names another switch than the relay")
    if relayed.domain is not None and not state.policy.trusts(relayed.domain):
        raise StatementError(DropReason.WRONG_DOMAIN, "an advertisement of a domain that is not trusted")
    if member.domain != state.policy.own and not advertisement.is_global:
        raise StatementError(DropReason.WRONG_DOMAIN, "a local name of another domain")
    if advertisement.right is Right.ATTACH:
        _check_identity(state, advertisement, now)
        if state.identities.is_refused_above(advertisement.node, advertisement.incarnation, now.mono_s):
            route = _route(state, advertisement, relayed, member, now)
            _forward(state, route, statement, route.sequence, now.mono_s)
            raise StatementError(DropReason.IN_USE, "another node with this identity, says the tier above")
    return advertisement, _check_news(state, advertisement, member)


def _check_identity(state: RibCoreState, advertisement: Advertisement, now: Timestamps) -> None:
    """Reject a node's own name in another incarnation while the older node lives at another switch.

    Raises:
        StatementError: IN_USE; the older node's switch has received a presence question.
    """
    held = state.store.get(advertisement.name, advertisement.node)
    if not isinstance(held, Route) or held.switch == advertisement.switch:
        return
    older = UnverifiedAdvertisement.from_statement(parse(held.advertisement)).incarnation
    node = advertisement.node
    if older == advertisement.incarnation or state.identities.is_free(node, older, held.switch, now.mono_s):
        return
    number = int(now.unix_s * 1_000)
    if state.identities.must_ask(node, older, held.switch, number, now.mono_s):
        question = Presence(node=node, incarnation=older, other=advertisement.switch, question=number)
        state.outbox.send_body(Kind.RIB_ANSWER, question, held.switch)
    raise StatementError(DropReason.IN_USE, "another node with this identity")


def _check_news(state: RibCoreState, advertisement: Advertisement, member: Membership) -> Route | Withdrawn | None:
    """Return what was known before of an advertisement that may be accepted.

    Raises:
        StatementError: STALE, LEASE_BOUNDS or QUOTA.
    """
    if advertisement.lease_s > state.settings.lease_max_s:
        raise StatementError(DropReason.LEASE_BOUNDS)
    known = state.store.get(advertisement.name, advertisement.node)
    if known is not None and advertisement.sequence <= known.sequence:
        repeated = advertisement.wire, member.domain
        if not isinstance(known, Route) or (known.advertisement, known.via) != repeated:
            raise StatementError(DropReason.STALE, str(known.sequence))
    if known is None or known.sender != member.name:
        check_quota(state.store, state.settings.names_per_sender, member.name, advertisement.node)
    return known


def _route(
    state: RibCoreState, advertisement: Advertisement, relayed: RelayedStatement, member: Membership, now: Timestamps
) -> Route:
    left_s = max(advertisement.valid_until_unix_s - now.unix_s, 1.0)
    is_own_switch = member.role.is_switch and member.domain == state.policy.own
    return Route.of(
        advertisement,
        sender=member.name,
        domain=member.domain,
        via=member.domain,
        transit=tuple(sorted(state.policy.transit)) if is_own_switch else relayed.transit,
        expires_s=now.mono_s + min(advertisement.lease_s, left_s),
    )


def _is_renewal(route: Route, known: Route | Withdrawn | None) -> bool:
    """Return whether an advertisement only extends the lease: those that watch renew their watches, and get it then."""
    if not isinstance(known, Route) or known.is_from_upstream:
        return False
    if (known.sender, known.place, known.transit) != (route.sender, route.place, route.transit):
        return False
    old, new = (UnverifiedAdvertisement.from_statement(parse(each.advertisement)) for each in (known, route))
    return replace(old, sequence=new.sequence) == new


def _refuse(state: RibCoreState, statement: Statement, member: Membership, error: StatementError, now_s: float) -> None:
    """Send a proven relay a rejecting AdvertiseAck, with the advertiser's present location if it has moved."""
    try:
        name = UnverifiedAdvertisement.from_statement(statement).subject.name
    except StatementError:
        return  # not even an advertisement: a response could name nothing; the caller counts it
    state.former.note_refused(name, error.reason)
    who, reason = statement.signer.to_text(), error.reason.label
    state.policy.audit.record(Action.REFUSED, "name", who=who, about=name.to_text(), reason=reason)
    known = state.store.get(name, statement.signer)
    if error.reason is DropReason.REVOKED:
        send_revoking(state, statement, member.name)
    state.outbox.send_ack((name, statement.signer), error.reason, 0 if known is None else known.sequence, member.name)
    if error.reason is DropReason.STALE and isinstance(known, Route) and known.sender != member.name:
        state.outbox.send_route(known, Asker.of(member), now_s)


def forward_due(state: RibCoreState, now_s: float) -> None:
    """Send the tier above the advertisements and withdrawals that are due."""
    for route, _, statement in state.upstream.due(now_s):
        upper = state.upstream.rib
        assert upper is not None
        relayed = RelayedStatement(statement, route.transit, state.identity.membership, route.domain)
        state.outbox.send_body(Kind.RIB_REQUEST, relayed, upper)


def _forward(state: RibCoreState, route: Route, statement: Statement, sequence: int, now_s: float) -> None:
    """Send the tier above an advertisement or a withdrawal until it acknowledges it."""
    if state.upstream.rib is not None:
        state.upstream.put(Passed(route, sequence, statement.wire), now_s)
        forward_due(state, now_s)
