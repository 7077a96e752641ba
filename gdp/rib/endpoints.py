"""Endpoint records at a RIB: where switches can be reached across IP networks, for other switches of their domains.

Sans-I/O; time comes in as ``Timestamps``. A switch publishes its own record over its channel, and renews it. The RIB
verifies membership, role, signature, sequence and quota, and keeps one record of each switch for ``ENDPOINT_LEASE_S``.
It passes the record on to the other RIBs of the domain. A RIB that has just started requests what its peers keep.

Records are sent to switches of the record's own domain only, and kept in memory: after a restart of all RIBs the
switches publish again. A change is sent to its watchers three times, because nothing acknowledges it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.control.endpoint_query import EndpointQuery, EndpointResponse, batches
from gdp.control.endpoint_record import EndpointRecord
from gdp.control.relayed_statement import RelayedStatement
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, check_sequence, parse
from gdp.due_queue import DueQueue
from gdp.errors import DropReason, StatementError
from gdp.frame.kinds import Kind
from gdp.limits import (
    ENDPOINT_LEASE_S,
    ENDPOINT_QUERIES_BURST,
    ENDPOINT_QUERIES_PER_S,
    ENDPOINT_RECORDS_BURST,
    ENDPOINT_RECORDS_MAX,
    ENDPOINT_RECORDS_OF_OTHERS_MAX,
    ENDPOINT_RECORDS_PER_S,
    RIB_WATCHES_MAX,
)
from gdp.names import Name
from gdp.rib.watches import Asker, Watches
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.domain import Policy

__all__ = ["RibEndpoints"]

_REPEAT_S: Final = (0.3, 0.8)  # after a change was sent to its watchers


class _Outgoing(NamedTuple):
    to: Name
    kind: Kind
    wire: bytes


@dataclass(slots=True)
class _Kept:
    record: EndpointRecord
    member: Membership
    expires_s: float


class RibEndpoints:
    """Endpoint records of one RIB.

    Args:
        peers: returns the other RIBs of the domain.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        peers: Callable[[], Iterable[Name]],
        watches: int = RIB_WATCHES_MAX,
        maximum: int = ENDPOINT_RECORDS_MAX,
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._peers = peers
        self._maximum = maximum
        self._kept: dict[Name, _Kept] = {}  # the first one to expire first
        self._of_others = 0  # records of other domains
        self._watches = Watches(watches)
        self._record_paces = TokenBuckets(ENDPOINT_RECORDS_PER_S, ENDPOINT_RECORDS_BURST)
        self._query_paces = TokenBuckets(ENDPOINT_QUERIES_PER_S, ENDPOINT_QUERIES_BURST)
        self._repeats = DueQueue[tuple[Name, int, float]]()  # of which switch, of which record, how long after it
        self._out: list[_Outgoing] = []

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, name: Name) -> EndpointRecord | None:
        """Return the record of a switch, or None."""
        kept = self._kept.get(name)
        return None if kept is None else kept.record

    def connected(self) -> None:
        """Request all records of the domain from the other RIBs: this RIB has just started, or was cut off."""
        query = EndpointQuery((), 0.0).to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._out += [_Outgoing(peer, Kind.RIB_REQUEST, query) for peer in self._peers()]

    def receive_record(self, statement: Statement, now: Timestamps) -> None:
        """Keep a record that its switch sent over its channel; the switch receives the result.

        Raises:
            StatementError: it is refused; beyond the permitted rate, without a response.
        """
        if not self._record_paces.spend(statement.signer, now.mono_s):
            raise StatementError(DropReason.QUOTA, "endpoint records of one switch")
        try:
            kept = self._keep(statement, now)
        except StatementError as error:
            self._respond(statement.signer, refused=error.reason)
            raise
        self._respond(statement.signer)
        if kept.member.domain == self._policy.own:
            relayed = RelayedStatement(statement.wire, (), self._identity.membership)
            for peer in self._peers():
                wire = relayed.to_wire(self._identity.name, self._identity.key)
                self._out.append(_Outgoing(peer, Kind.RIB_REQUEST, wire))

    def receive_relayed(self, statement: Statement, member: Membership, now: Timestamps) -> None:
        """Keep a record that a proven RIB of this domain passed on; it goes no further.

        Raises:
            StatementError: it is refused.
        """
        if member.role is not Role.RIB or member.domain != self._policy.own:
            raise StatementError(DropReason.WRONG_DOMAIN, "an endpoint record from another than its switch")
        self._keep(statement, now)

    def receive_response(self, statement: Statement, member: Membership, now: Timestamps) -> None:
        """Keep the records that a proven RIB of this domain sent when requested.

        Raises:
            StatementError: the response is not valid; a record in it that is refused raises nothing.
        """
        if member.role is not Role.RIB or member.domain != self._policy.own:
            raise StatementError(DropReason.WRONG_DOMAIN, "endpoint records of another than a RIB of this domain")
        refused: StatementError | None = None
        for wire in EndpointResponse.from_fields(statement.fields).records:
            try:
                self._keep(parse(wire), now)
            except StatementError as error:
                refused = refused if error.reason is DropReason.STALE else error
        if refused is not None:
            raise refused

    def _keep(self, statement: Statement, now: Timestamps) -> _Kept:
        known = self._kept.get(statement.signer)
        if known is not None and known.record.wire == statement.wire:  # renewed
            self._check(known, now)
            known.expires_s = now.mono_s + ENDPOINT_LEASE_S
            self._kept[known.record.name] = self._kept.pop(known.record.name)
            return known
        record, member = EndpointRecord.verified(statement.wire, self._policy, now.unix_s)
        if not member.role.is_switch:
            raise StatementError(DropReason.NOT_DELEGATED, "only switches publish endpoints")
        check_sequence(record.sequence, now.unix_s)
        if known is not None and record.sequence <= known.record.sequence:
            raise StatementError(DropReason.STALE, "endpoint record")
        is_of_other = member.domain != self._policy.own
        was_of_other = known is not None and known.member.domain != self._policy.own
        if known is None and len(self._kept) >= self._maximum:
            raise StatementError(DropReason.QUOTA, "endpoint records")
        others_max = min(ENDPOINT_RECORDS_OF_OTHERS_MAX, self._maximum // 2)
        if is_of_other and not was_of_other and self._of_others >= others_max:
            raise StatementError(DropReason.QUOTA, "endpoint records of other domains")
        self._of_others += is_of_other - was_of_other
        self._kept.pop(record.name, None)
        kept = self._kept[record.name] = _Kept(record, member, now.mono_s + ENDPOINT_LEASE_S)
        self._tell(kept, now.mono_s)
        for after_s in _REPEAT_S:
            self._repeats.put((record.name, record.sequence, after_s), now.mono_s + after_s)
        return kept

    def _check(self, kept: _Kept, now: Timestamps) -> None:
        self._policy.check_member(kept.member, now.unix_s)
        if kept.record.until_unix_s < now.unix_s:
            raise StatementError(DropReason.EXPIRED, "endpoint record")

    def handle_query(self, statement: Statement, member: Membership, now: Timestamps) -> None:
        """Respond to a proven switch or RIB with the records that it lacks, and watch them for it.

        Raises:
            StatementError: it may not ask, or asks too often; QUOTA after the response, there are too many watches.
        """
        query = EndpointQuery.from_fields(statement.fields)
        is_peer = member.role is Role.RIB and member.domain == self._policy.own
        if not member.role.is_switch and not is_peer:
            raise StatementError(DropReason.NOT_DELEGATED, "only switches and RIBs of this domain ask for endpoints")
        if not self._query_paces.spend(member.name, now.mono_s):
            raise StatementError(DropReason.QUOTA, "queries for endpoints")
        if is_peer:
            wanted = [kept for kept in self._kept.values() if kept.member.domain == self._policy.own]
            self._send(member.name, [kept.record.wire for kept in wanted if self._is_valid(kept, now)])
            return
        asker = Asker(member.name, member.domain, False)
        lacked: list[bytes] = []
        refused: StatementError | None = None
        for name, sequence in query.known:
            kept = self._kept.get(name)
            if kept is not None and kept.record.sequence > sequence and self._may_tell(kept, asker):
                lacked += [kept.record.wire] if self._is_valid(kept, now) else []
            try:
                if query.watch_s > 0:
                    self._watches.add(name, asker, now.mono_s + query.watch_s)
            except StatementError as error:
                refused = error  # without a watch it learns changes by its next query
        self._send(member.name, lacked)
        if refused is not None:
            raise refused

    def recheck(self, now: Timestamps) -> None:
        """Drop records whose membership is no longer valid: a certificate was revoked."""
        for name, kept in list(self._kept.items()):
            if not self._is_valid(kept, now):
                self._drop(name)

    def handle_timer(self, now: Timestamps) -> None:
        """Drop records that were not renewed, and send changes once more to their watchers."""
        while self._kept and next(iter(self._kept.values())).expires_s <= now.mono_s:
            self._drop(next(iter(self._kept)))
        self._watches.expire(now.mono_s)
        for name, sequence, _ in self._repeats.poll_due(now.mono_s):
            known = self._kept.get(name)
            if known is not None and known.record.sequence == sequence and self._is_valid(known, now):
                self._tell(known, now.mono_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self._repeats.next_due(), next(iter(self._kept.values())).expires_s if self._kept else None]
        return min((each for each in times if each is not None), default=None)

    def poll_statements(self) -> list[_Outgoing]:
        """Return, once, the statements to send: receiver, kind and wire form."""
        out, self._out = self._out, []
        return out

    def _is_valid(self, kept: _Kept, now: Timestamps) -> bool:
        try:
            self._check(kept, now)
        except StatementError:
            return False
        return True

    def _drop(self, name: Name) -> None:
        self._of_others -= self._kept.pop(name).member.domain != self._policy.own

    @staticmethod
    def _may_tell(kept: _Kept, asker: Asker) -> bool:
        """Return whether an asker may receive a record: endpoints stay within the domain of their switch."""
        return kept.member.domain == asker.domain and kept.member.name != asker.name

    def _tell(self, kept: _Kept, now_s: float) -> None:
        for asker in self._watches.watchers(kept.record.name, now_s):
            if self._may_tell(kept, asker):
                self._respond(asker.name, (kept.record.wire,))

    def _send(self, to: Name, records: list[bytes]) -> None:
        for batch in batches(records, self._identity.membership) or [()]:
            self._respond(to, batch)

    def _respond(self, to: Name, records: tuple[bytes, ...] = (), refused: DropReason | None = None) -> None:
        own = self._kept.get(to)
        response = EndpointResponse(
            records=records, kept_sequence=0 if own is None else own.record.sequence, refused=refused
        )
        wire = response.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        self._out.append(_Outgoing(to, Kind.RIB_ANSWER, wire))
