"""Revocations at a RIB: which it stores, which routes they close, and which nodes receive them.

Sans-I/O. A RIB stores revocations by trusted domains, and an owner's revocations for a name that is stored or watched
here. It sends them to the nodes that advertised, hold or watch that name, in the tiers above and below. Later askers
about the name receive them, too. A revocation that concerns nothing here is only forwarded to the tier above, at a
bounded rate, and is not stored.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from gdp.control.rib_statements import Query, RelayedStatement
from gdp.crypto.statements import Statement, parse
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.rib.route import Route
from gdp.rib.state import RibCoreState
from gdp.rib.watches import Asker
from gdp.sansio import Timestamps
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.audit import Action
from gdp.trust.revocation import Revocation

_SENT_ABOUT_MAX: Final = 1_024  # in one response
_NAMES_OF_ISSUER_MAX: Final = 256  # names whose watchers receive a revocation by an issuer that is not the names' owner


def receive_revocation(state: RibCoreState, statement: Statement, origin: Name, now: Timestamps) -> None:
    """Handle a revocation from a neighbour or a relay: it removes routes, and is sent on."""
    issued_for = Revocation.read(statement).issuer.name

    def holds(key: bytes) -> bool:
        is_watched = state.store.has_issuer(key) or state.outbox.watches.watchers(issued_for, now.mono_s)
        return bool(is_watched or state.store.routes(issued_for))

    try:
        revocation = state.policy.revoked.receive_revocation(statement, origin, now, holds)
    except StatementError as error:
        if error.reason is DropReason.UNCONCERNED:
            _pass_up(state, statement, origin, now)
        raise
    if revocation is None:
        _pass_up(state, statement, origin, now)  # it is repeated for those that lacked it
        return
    state.endpoints.recheck(now)
    who, about = revocation.issuer.name.to_text(), revocation.fingerprint.hex()
    state.policy.audit.record(Action.REVOKED, "certificate", who=who, about=about)
    closed = _closed_by(state, revocation, now)
    # switches flood revocations of roots everywhere
    if not state.policy.revoked.is_root(revocation.issuer.owner_key):
        recipients = _affected(state, revocation, closed, now.mono_s)
        ribs = _upstream_and_peers(state, origin)
        _send(state, [statement.wire], ribs, Kind.RIB_REQUEST)
        _send(state, [statement.wire], [each.name for each in recipients if each.name not in (origin, *ribs)])
    for route in closed:
        state.store.withdraw(route.name, route.advertiser)
        state.outbox.notify_gone(route, now.mono_s)


def send_lacked(state: RibCoreState, query: Query, to: Name, now_s: float) -> None:
    """Send an asker the revocations about a name that it lacks, if it asked for them."""
    if query.revoked is not None and query.revoked != state.policy.revoked.digest_about(query.name):
        about = state.policy.revoked.about(query.name)[:_SENT_ABOUT_MAX]
        _send(state, [wire for wire in about if state.revocation_paces.spend(to, now_s)], [to])


def send_revoking(state: RibCoreState, advertisement: Statement, to: Name) -> None:
    """Send a relay the statements that revoked certificates in an unverified advertisement's evidence."""
    body = UnverifiedAdvertisement.from_statement(advertisement)
    issuer_key = body.subject.owner_key
    found: list[bytes | None] = []
    for wire in body.chain:
        link = AdCert.from_statement(parse(wire))
        keys = dict.fromkeys((body.subject.owner_key, issuer_key))
        found += [state.policy.revoked.wire(key, link.fingerprint) for key in keys]
        issuer_key = link.delegate_key
    _send(state, [wire for wire in found if wire is not None], [to])


def _closed_by(state: RibCoreState, revocation: Revocation, now: Timestamps) -> list[Route]:
    """Return the routes that depend on what was revoked, and are no longer valid."""
    closed = []
    for route in state.store.resting_on(revocation.fingerprint):
        try:
            state.verifier.verify(route.advertisement, now.unix_s)
        except StatementError:
            closed.append(route)
    return closed


def _affected(state: RibCoreState, revocation: Revocation, closed: list[Route], now_s: float) -> dict[Asker, None]:
    """Return the nodes that advertised, hold or watch a name that a revocation affects."""
    recipients: dict[Asker, None] = {}
    for name in dict.fromkeys((revocation.issuer.name, *(route.name for route in closed))):
        recipients |= state.outbox.concerned_by(name, now_s)
    if not recipients:  # the issuer signs in its own name: an owner's successor, or a delegate
        others = state.store.resting_on(revocation.issuer.owner_key)
        for name in list(dict.fromkeys(route.name for route in others))[:_NAMES_OF_ISSUER_MAX]:
            recipients |= state.outbox.concerned_by(name, now_s)
    return recipients


def _pass_up(state: RibCoreState, statement: Statement, sender: Name, now: Timestamps) -> None:
    """Forward a revocation that changes nothing here to the tier above, if that is allowed, at a bounded rate."""
    upper = state.upstream.rib
    is_root = state.policy.revoked.is_root(Revocation.read(statement).issuer.owner_key)
    if upper is None or is_root or state.upstream.has(sender) or sender in state.settings.peers:
        return
    if state.passed_paces.spend(sender, now.mono_s):
        Revocation.from_statement(statement)
        _send(state, [statement.wire], [upper], Kind.RIB_REQUEST)


def _upstream_and_peers(state: RibCoreState, origin: Name) -> list[Name]:
    """Return the RIBs that receive every revocation: the tier above, and peers."""
    if state.upstream.has(origin):
        return list(state.settings.peers)
    upstream = [] if state.upstream.rib is None else [state.upstream.rib]
    return upstream if origin in state.settings.peers else [*upstream, *state.settings.peers]


def _send(state: RibCoreState, wires: Iterable[bytes], to: Iterable[Name], kind: Kind = Kind.RIB_ANSWER) -> None:
    for wire in wires:
        state.outbox.send_body(kind, RelayedStatement(wire, (), state.identity.membership), *to)
