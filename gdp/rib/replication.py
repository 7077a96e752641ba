"""Replication between the RIBs of one domain: each stores what any of them accepts, routes and endpoint records.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Changes are pushed at once; ``exchange/anti_entropy.py`` finds
what was lost. Entries prove themselves.
"""

from __future__ import annotations

from typing import Final

from gdp.control.endpoints import ENDPOINTS
from gdp.control.rib_replication import Entry
from gdp.crypto.certificates import Role
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage
from gdp.frame.codec import Kind
from gdp.limits import CLOCK_SKEW_S
from gdp.rib.outbox import OutgoingStatement
from gdp.rib.route import Route, Withdrawn
from gdp.rib.state import ROUTES, RibCoreState
from gdp.rib.store import check_quota
from gdp.sansio import Timestamps
from gdp.trust.advertisement import Advertisement, Withdrawal

COLD_S: Final = 3.0  # a RIB that just started denies no name before it compared with a peer, for so long at most


def is_cold(state: RibCoreState, now_s: float) -> bool:
    """Return whether this RIB may still lack what its peers hold."""
    is_late = state.started_s is not None and now_s - state.started_s >= COLD_S
    state.is_warm = state.is_warm or is_late or ROUTES in state.exchange.compared
    return not state.is_warm


def poll_replication(state: RibCoreState) -> list[OutgoingStatement]:
    """Return, once, the statements to send to peers."""
    wires: dict[int, bytes] = {}  # a message that is pushed to all is signed once
    messages = state.exchange.poll_messages(state.now_s)
    for _, message in messages:
        if id(message) not in wires:
            wires[id(message)] = state.identity.signed(message)
    return [OutgoingStatement(peer, Kind.RIB_REQUEST, wires[id(message)]) for peer, message in messages]


def receive_sync(state: RibCoreState, statement: Statement, now: Timestamps) -> None:
    """Take part in equalising a set with a RIB of this domain, or answer a switch that asks for endpoints.

    An invalid item is only counted.
    """
    member = state.policy.verify_sender(statement, now.unix_s)
    is_peer = member.role is Role.RIB and member.domain == state.policy.own
    if not is_peer and not member.role.is_switch:
        raise StatementError(DropReason.WRONG_DOMAIN, "replicates with RIBs of this domain only")
    statement.verify(member.key)
    message = SyncMessage.from_fields(statement.fields)
    if not is_peer:
        state.endpoints.handle_query(message, member, now)
        return
    if not state.accept_peer(member.name, now.mono_s):
        raise StatementError(DropReason.QUOTA, "peers")
    for item in state.exchange.receive_message(member.name, message, now.mono_s):
        try:
            if message.of == ENDPOINTS:
                state.endpoints.receive_item(item, now)
            elif message.of in state.sets:
                receive_entry(state, Entry.from_cbor(item), now)
        except StatementError as error:
            state.refusals[error.reason] += 1


def receive_entry(state: RibCoreState, entry: Entry, now: Timestamps) -> None:
    """Handle an entry of a peer as if it had arrived here.

    Raises:
        StatementError: it is not valid; an entry that is merely no news raises nothing.
    """
    statement = parse(entry.statement)
    if statement.type is StatementType.WITHDRAW:
        _receive_withdrawn(state, entry, statement, now)
        return
    advertisement = state.verifier.verify_statement(statement, now.unix_s)
    known = state.store.get(advertisement.name, advertisement.node)
    lease_s = min(entry.lease_s, advertisement.lease_s, advertisement.valid_until_unix_s - now.unix_s)
    if lease_s <= 0 or advertisement.lease_s > state.settings.lease_max_s:
        raise StatementError(DropReason.LEASE_BOUNDS)
    if known is not None and not _is_newer(advertisement, known, now.mono_s + lease_s):
        return
    if entry.is_from_upstream and (not isinstance(known, Route) or known.is_from_upstream):
        return  # no entry here that it corrects
    if known is None:
        check_quota(state.store, state.settings.names_per_sender, entry.sender, advertisement.node)
    route = Route.of(
        advertisement,
        sender=entry.sender,
        domain=entry.domain,
        via=entry.via,
        transit=entry.transit,
        expires_s=now.mono_s + lease_s,
        is_from_upstream=entry.is_from_upstream,
    )
    state.store.put(route)
    state.outbox.notify(route, known, now.mono_s, state.upstream_queries.answered(route.name, now.mono_s))


def _is_newer(advertisement: Advertisement, known: Route | Withdrawn, expires_s: float) -> bool:
    """Return whether a peer's advertisement replaces the known one: a higher sequence, or the same for longer."""
    if advertisement.sequence != known.sequence:
        return advertisement.sequence > known.sequence
    if not isinstance(known, Route) or known.advertisement != advertisement.wire:
        return False
    return known.is_from_upstream or expires_s > known.expires_s


def _receive_withdrawn(state: RibCoreState, entry: Entry, statement: Statement, now: Timestamps) -> None:
    withdrawal = Withdrawal.received(statement, now.unix_s)
    name, sequence = withdrawal.name, withdrawal.sequence
    known = state.store.get(name, statement.signer)
    if known is not None and known.rank >= 2 * sequence + 1:
        return
    member = state.policy.verify_sender(statement, now.unix_s, entry.membership)
    statement.verify(member.key)
    until_unix_s = min(entry.until_unix_s, member.not_after_unix_s + int(CLOCK_SKEW_S))
    if known is not None:  # a peer must not shorten the lease of a known entry
        until_unix_s = max(until_unix_s, known.valid_until_unix_s)
    if until_unix_s <= now.unix_s:
        return  # expired here already
    if known is None:
        check_quota(state.store, state.settings.names_per_sender, entry.sender, statement.signer)
    gone = Withdrawn(entry.sender, sequence, until_unix_s, statement.wire, entry.membership)
    route = state.store.withdraw(name, statement.signer, gone)
    if route is not None:
        state.outbox.notify_gone(route, now.mono_s, by=entry.sender)
