"""RIB of a domain: which nodes advertise a name, and at which switches, by proof alone.

Sans-I/O; it takes statements and returns statements to send, each for a name. Their transport is the task of its host
(``gdp/client/rib_host.py``). Each type of statement has a handler, in the file of its subject; all work on one state.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

from gdp.control.boundary import ErrorBoundary
from gdp.control.rib_replication import Entry
from gdp.control.rib_statements import RelayedStatement
from gdp.control.waiting import Wait, WaitReason
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity
from gdp.crypto.schema import NAME, Keyed
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.due_queue import earliest
from gdp.errors import DropReason, RemoteError, StatementError, StoreError
from gdp.names import Name
from gdp.rib.advertisements import forward_due, receive_ack, receive_advertisement, receive_presence, receive_withdrawal
from gdp.rib.outbox import OutgoingStatement
from gdp.rib.queries import handle_query_timer, keep_of_silent_rib, receive_query, receive_response
from gdp.rib.replication import poll_replication, receive_entry, receive_sync
from gdp.rib.revocations import receive_revocation
from gdp.rib.route import Route
from gdp.rib.state import RibCoreState, RibSettings
from gdp.rib.store import Store
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy


class RibCore:
    """Sans-I/O core of one RIB."""

    def __init__(self, identity: Identity, policy: Policy, store: Store, settings: RibSettings) -> None:
        self.state = RibCoreState(identity, policy, store, settings)
        self._is_moved = True  # something may be due at another time than ``_due_s``
        self._due_s: float | None = None
        self.boundary = ErrorBoundary()
        self._counting_refusals = _CountingRefusals(self.state.refusals)

    @property
    def names(self) -> int:
        """Return how many routes are stored."""
        return len(self.state.store)

    def receive_all(self, wires: Sequence[tuple[bytes, Name]], now: Timestamps) -> None:
        """Handle statements, each with its sender; the entries that they concern are read from the store in one go."""
        if self.state.store.digests is None:
            self.state.store.prefetch([name for wire, _ in wires if (name := _name_in(wire)) is not None], now)
        for wire, sender in wires:
            self.receive(wire, sender, now)

    def receive(self, wire: bytes, sender: Name, now: Timestamps) -> None:
        """Handle a statement from ``sender`` (from the frame header; unproven). Each invalid statement is counted."""
        self.state.now_s, self._is_moved = now.mono_s, True
        self.state.outbox.watches.expire(now.mono_s)
        self.state.outbox.holders.expire(now.mono_s)
        try:
            with self._counting_refusals:
                statement = parse(wire)
                if statement.signer != sender:
                    raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
                if (handle := _HANDLERS.get(statement.type)) is None:
                    raise StatementError(DropReason.MALFORMED, f"a RIB takes no {statement.type.value}")
                handle(self.state, statement, now)
        except Exception as error:  # one statement must not stop the RIB
            self.boundary.record(error)
            self.state.refusals[DropReason.INTERNAL] += 1

    def revoke(self, wire: bytes, origin: Name, now: Timestamps) -> None:
        """Handle a revocation that came over a neighbour, ``origin``; an invalid one is counted."""
        self.state.now_s, self._is_moved = now.mono_s, True
        with self._counting_refusals:
            receive_revocation(self.state, parse(wire), origin, now)

    def changed(self, names: Iterable[tuple[Name, list[Route]]], now: Timestamps) -> None:
        """Send watchers what another RIB changed in a shared store, given the routes that were known before."""
        state, now_s = self.state, now.mono_s
        state.now_s, self._is_moved = now_s, True
        queries = state.upstream_queries
        concerned = [
            (name, before)
            for name, before in names
            if state.outbox.interested_in(name, now_s) or queries.is_waiting(name)
        ]
        state.store.prefetch([name for name, _ in concerned], now)
        for name, before in concerned:
            with self._counting_refusals:
                routes = {route.advertiser: route for route in state.store.routes(name)}
                known = {route.advertiser: route for route in before}
                for advertiser, route in routes.items():
                    state.outbox.notify(route, known.get(advertiser), now_s, queries.answered(name, now_s))
                for advertiser in known.keys() - routes.keys():
                    state.outbox.notify_gone(known[advertiser], now_s)

    def load(self, entries: Iterable[Entry], now: Timestamps) -> int:
        """Load entries of a snapshot, each verified; return how many are live. Each invalid entry is counted."""
        before, self._is_moved = self.names, True
        for entry in entries:
            with self._counting_refusals:
                receive_entry(self.state, entry, now)
        return self.names - before

    def connected(self, now: Timestamps) -> None:
        """Begin to replicate: there is a switch, and messages reach the peers from now on."""
        state = self.state
        state.now_s, self._is_moved = now.mono_s, True
        if state.started_s is None:
            state.started_s = now.mono_s
        state.exchange.announce(now.mono_s)

    def handle_timer(self, now: Timestamps) -> None:
        """Expire routes and notify their watchers; repeat open queries upstream."""
        state, now_s = self.state, now.mono_s
        state.now_s, self._is_moved = now_s, True
        for route in state.store.expire(now_s, now.unix_s):
            if not keep_of_silent_rib(state, route, now):
                state.former.note_gone(route, is_lapsed=True)
                state.outbox.notify_gone(route, now_s)
        state.exchange.handle_timer(now_s)
        state.endpoints.handle_timer(now)
        handle_query_timer(state, now)
        forward_due(state, now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self._is_moved:
            state, self._is_moved = self.state, False
            of_tier_above = earliest(state.upstream_queries.next_due(), state.upstream.next_due())
            of_entries = earliest(state.store.next_expiry(), state.endpoints.get_timer())
            self._due_s = earliest(of_entries, of_tier_above, state.exchange.get_timer())
        return self._due_s

    def statements_to_send(self) -> list[OutgoingStatement]:
        """Return, once, the statements to send."""
        state = self.state
        letters = state.outbox.poll_statements() + poll_replication(state)
        return letters + state.endpoints.poll_statements()

    def waits(self, now_s: float) -> list[Wait]:
        """Return what this RIB waits for."""
        upstream = self.state.upstream
        return [Wait(WaitReason.NO_UPPER_RIB, name=upstream.rib)] if upstream.is_silent(now_s) else []


class _CountingRefusals:
    """Context that counts a statement that is refused, or that a shared store could not serve: it will come again."""

    def __init__(self, refusals: Counter[DropReason]) -> None:
        self._refusals = refusals

    def __enter__(self) -> None: ...

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> bool:
        if isinstance(error, RemoteError):
            self._refusals[error.reason] += 1
        elif isinstance(error, StoreError):
            self._refusals[DropReason.UNAVAILABLE] += 1
        else:
            return False
        return True


def _receive_relay(state: RibCoreState, statement: Statement, now: Timestamps) -> None:
    """Hand a statement that a proven switch or RIB relays to its handler."""
    relayed = RelayedStatement.from_fields(statement.fields)
    member = state.policy.verify_sender(statement, now.unix_s, relayed.membership)
    if not (member.role.is_switch or member.role is Role.RIB):
        raise StatementError(DropReason.WRONG_DOMAIN, "relays are switches or RIBs")
    statement.verify(member.key)
    if member.role is Role.RIB:
        state.lower.record_alive(member.name, now.mono_s)
    inner = parse(relayed.statement)
    if (handle := _RELAYED.get(inner.type)) is None:
        raise StatementError(DropReason.MALFORMED, f"a RIB takes no relayed {inner.type.value}")
    handle(state, inner, relayed, member, now)


_RelayHandler = Callable[[RibCoreState, Statement, RelayedStatement, Membership, Timestamps], None]
_HANDLERS: Final[Mapping[StatementType, Callable[[RibCoreState, Statement, Timestamps], None]]] = {
    StatementType.RELAY: _receive_relay,
    StatementType.QUERY: receive_query,
    StatementType.ANSWER: receive_response,
    StatementType.ADVERTISE_ACK: receive_ack,
    StatementType.PRESENCE: receive_presence,
    StatementType.SYNC: receive_sync,
    StatementType.ENDPOINTS: lambda state, statement, now: state.endpoints.receive_record(statement, now),
}
_RELAYED: Final[Mapping[StatementType, _RelayHandler]] = {
    StatementType.ADVERTISE: receive_advertisement,
    StatementType.WITHDRAW: receive_withdrawal,
    StatementType.REVOKE: lambda state, statement, _relayed, member, now: receive_revocation(
        state, statement, member.name, now
    ),
}


def _name_in(wire: bytes) -> Name | None:
    """Return the name that a query or a relay is about, unverified; None for other statements."""
    try:
        statement = parse(wire)
        if statement.type is StatementType.RELAY:
            statement = parse(RelayedStatement.from_statement(statement).statement)
        return Keyed("name" if statement.type is StatementType.ADVERTISE else "n", NAME).read(statement.fields)
    except StatementError:
        return None
