"""Queries of switches and RIBs below, and to the tier above: each way with its responses.

Sans-I/O. The bytes of the answers to one asker are bounded. The routes that a silent tier above gave are kept (RFC 8767
in spirit), and so are those of a silent RIB below.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from gdp.control.rib_statements import Query, Response
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.statements import Statement
from gdp.errors import DropReason, StatementError, StoreError
from gdp.frame.codec import Kind
from gdp.intervals import LEASE_MIN_S
from gdp.names import Name
from gdp.rib.replication import is_cold
from gdp.rib.revocations import send_lacked
from gdp.rib.route import Route, Withdrawn
from gdp.rib.state import ROUTES, RibCoreState
from gdp.rib.upstream_advertisements import PROBE_S
from gdp.rib.upstream_queries import WATCH
from gdp.rib.watches import Asker
from gdp.sansio import Timestamps

_QUESTION_BYTES: Final = 1_024  # cost of a query, forwarded upstream or answered in the negative
_ANSWER_BYTES: Final = 1_024  # cost of a response without the advertisement in it
_DOUBT_S: Final = 0.1  # a RIB above that is silent for so long receives a probe with the next query


def receive_query(state: RibCoreState, statement: Statement, now: Timestamps) -> None:
    """Respond to a query of a switch or a RIB; watch the name for its asker if it wants that."""
    member = state.policy.verify_sender(statement, now.unix_s)
    if not (member.role.is_switch or member.role is Role.RIB):
        raise StatementError(DropReason.NOT_DELEGATED, "only switches and RIBs ask")
    statement.verify(member.key)
    if member.role is Role.RIB:
        state.lower.record_alive(member.name, now.mono_s)
    query = Query.from_fields(statement.fields)
    if query.name == state.identity.name:
        state.outbox.send_none(query.name, member.name)  # a probe for a sign of life
        return
    asker = Asker.of(member)
    name = query.name
    routes = [route for route in state.store.routes(name) if state.outbox.may_receive(route, asker)]
    cost = _QUESTION_BYTES + sum(len(route.advertisement) + _ANSWER_BYTES for route in routes)
    if not state.answer_paces.spend(member.name, now.mono_s, cost):
        raise StatementError(DropReason.QUOTA, "answers to one asker")
    if query.watch_s > 0:
        try:
            state.outbox.watches.add(name, asker, now.mono_s + query.watch_s)
        except StatementError as error:  # it still gets a response, and will send its query again
            state.refusals[error.reason] += 1
    send_lacked(state, query, member.name, now.mono_s)
    for route in routes:
        state.outbox.send_route(route, asker, now.mono_s)
    queries = state.upstream_queries
    is_below = not state.upstream.has(member.name)
    if is_below and queries.request(name, asker, query.watch_s, now.mono_s, is_known=bool(routes)):
        _query_upper(state, name, queries.watch_s(name), now.mono_s)
    elif not routes and not queries.is_waiting(name):
        _send_none(state, name, member.name, now.mono_s, is_unknown=bool(state.settings.upper))


def receive_response(state: RibCoreState, statement: Statement, now: Timestamps) -> None:
    """Handle a response of the tier above, or a sign of life of a RIB below."""
    response = Response.from_fields(statement.fields)
    if response.name == statement.signer and not state.upstream.has(statement.signer):  # a RIB below answers a probe
        below = state.policy.verify_sender(statement, now.unix_s)
        statement.verify(below.key)
        state.lower.record_alive(below.name, now.mono_s)
        return
    member = state.verify_upper(statement, now)
    if response.is_negative or response.is_unknown:
        _receive_none(state, response, now)
        return
    known = state.store.get(response.name, response.advertiser)
    if response.advertisement:
        _learn(state, response, member, known, now)
    elif isinstance(known, Route) and known.is_from_upstream and known.sequence <= response.sequence:
        state.store.withdraw(response.name, response.advertiser)
        state.outbox.notify_gone(known, now.mono_s)


def handle_query_timer(state: RibCoreState, now: Timestamps) -> None:
    """Repeat queries to the tier above; of several RIBs there, replace a silent one."""
    now_s = now.mono_s
    if state.upstream.turn_over(now_s):
        state.upstream_queries.ask_again(now_s)
    ask, given_up = state.upstream_queries.due(now_s, is_silent=state.upstream.is_silent(now_s))
    for query in ask:
        if query.is_unanswered:
            _keep_stale(state, query.name, query.again_s, now)
        _query_upper(state, query.name, query.watch_s, now_s)
    for name, askers in given_up:
        for asker in askers:
            _send_none(state, name, asker.name, now_s, is_unknown=True)
    for rib in state.upstream.preferred(now_s):
        _send_query(state, rib, rib, 0.0, now_s)
    _probe(state, now_s, PROBE_S)


def keep_of_silent_rib(state: RibCoreState, route: Route, now: Timestamps) -> bool:
    """Keep a route whose lease ended if the RIB below that relayed it is silent; return whether that is so."""
    if route.is_from_upstream or route.sender == route.switch or now.unix_s >= route.valid_until_unix_s:
        return False
    keep_s = state.lower.keep_s(route.sender, now.mono_s)
    if keep_s == 0.0:
        return False
    _keep(state, route, now.mono_s + keep_s, now.mono_s)
    if state.lower.is_probe_due(route.sender, now.mono_s):
        state.outbox.send_body(Kind.RIB_REQUEST, Query(route.sender, 0.0), route.sender)
    return True


def _receive_none(state: RibCoreState, response: Response, now: Timestamps) -> None:
    """Handle a response that no node advertises a name, or that the tier above does not know."""
    askers = state.upstream_queries.answered(response.name, now.mono_s, is_unknown=response.is_unknown)
    if response.is_unknown:
        _keep_stale(state, response.name, now.mono_s + WATCH.refresh_s, now)
    if not state.store.routes(response.name):
        for asker in askers:
            _send_none(state, response.name, asker.name, now.mono_s, is_unknown=response.is_unknown)


def _learn(
    state: RibCoreState, response: Response, member: Membership, known: Route | Withdrawn | None, now: Timestamps
) -> None:
    advertisement = state.verifier.verify(response.advertisement, now.unix_s)
    if advertisement.name != response.name or advertisement.node != response.advertiser:
        raise StatementError(DropReason.WRONG_NAME, "an answer about something else than its advertisement")
    own = known if isinstance(known, Route) and not known.is_from_upstream else None
    if response.domain == state.policy.own or (own is not None and own.advertisement == advertisement.wire):
        return  # our own, or of a tier below, returned from above
    if isinstance(known, Route) and advertisement.sequence < known.sequence:
        raise StatementError(DropReason.STALE, "the tier above is behind")
    route = Route.of(
        advertisement,
        sender=member.name,
        domain=response.domain,
        via=member.domain,
        transit=response.transit,
        expires_s=now.mono_s + response.lease_s,
        is_from_upstream=True,
    )
    state.store.put(route)
    if own is not None:
        state.exchange.push(ROUTES, b"".join(route.key))  # a peer has the old location
    state.outbox.notify(
        route, known, now.mono_s, state.upstream_queries.answered(route.name, now.mono_s, response.lease_s)
    )


def _keep_stale(state: RibCoreState, name: Name, until_s: float, now: Timestamps) -> None:
    """Keep the routes that the tier above gave until it is asked next, as it does not respond (as in RFC 8767).

    The proofs of an advertisement still end it.
    """
    try:
        routes = state.store.routes(name)
    except StoreError:
        state.refusals[DropReason.UNAVAILABLE] += 1  # a shared store that is away, too, keeps its routes itself
        return
    for route in routes:
        is_lapsing = route.expires_s < until_s + LEASE_MIN_S
        if route.is_from_upstream and is_lapsing and now.unix_s < route.valid_until_unix_s:
            _keep(state, route, max(until_s, now.mono_s + WATCH.refresh_s), now.mono_s)


def _keep(state: RibCoreState, route: Route, until_s: float, now_s: float) -> None:
    """Keep a route beyond its lease, and notify those that it concerns."""
    stale = replace(route, expires_s=until_s + LEASE_MIN_S)
    state.store.put(stale)
    state.outbox.notify(stale, route, now_s)


def _query_upper(state: RibCoreState, name: Name, watch_s: float, now_s: float) -> None:
    """Query the RIB above for a name, and watch it there for ``watch_s``."""
    _send_query(state, state.upstream.rib, name, watch_s, now_s)
    _probe(state, now_s, _DOUBT_S)


def _probe(state: RibCoreState, now_s: float, quiet_s: float) -> None:
    """Send one of several RIBs above a probe if it gave no sign of life for ``quiet_s``."""
    upper = state.upstream.rib
    if upper is not None and state.upstream.probe(now_s, quiet_s):
        _send_query(state, upper, upper, 0.0, now_s)


def _send_query(state: RibCoreState, upper: Name | None, name: Name, watch_s: float, now_s: float) -> None:
    assert upper is not None
    state.upstream.record_asked(now_s)
    revoked = state.policy.revoked.digest_about(name) if watch_s > 0 else None
    state.outbox.send_body(Kind.RIB_REQUEST, Query(name, watch_s, revoked), upper)


def _send_none(state: RibCoreState, name: Name, to: Name, now_s: float, *, is_unknown: bool) -> None:
    """Answer that no node advertises a name, or that it is not known, if no peer may know: the query is repeated."""
    if not is_cold(state, now_s):
        state.outbox.send_none(name, to, is_unknown=is_unknown)
