"""Endpoint records at a RIB: where switches can be reached across IP networks, for other switches of their domains.

Sans-I/O; time comes in as ``Timestamps``. A switch publishes its own record over its channel, and renews it. The RIB
verifies membership, role, signature, sequence and quota, and keeps one record of each switch for ``ENDPOINT.lease_s``.
The RIBs of a domain equalise the records of its switches.

Records are sent to switches of the record's own domain only, and kept in memory: after a restart of all RIBs the
switches publish again. A change is sent to its watchers three times, because nothing acknowledges it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from gdp.control.endpoints import ENDPOINT_NAMES_MAX, ENDPOINTS, EndpointRecord, item_of, record_in
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, check_sequence, parse
from gdp.due_queue import DueQueue, earliest
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage, pages
from gdp.exchange.sync_set import SyncSet, line_of, rank_in
from gdp.frame.codec import Kind
from gdp.intervals import ENDPOINT, LEASE_MIN_S
from gdp.limits import (
    ENDPOINT_QUERIES_RATE,
    ENDPOINT_RECORDS_MAX,
    ENDPOINT_RECORDS_OF_OTHERS_MAX,
    ENDPOINT_RECORDS_RATE,
    RIB_WATCHES_MAX,
)
from gdp.names import NAME_BYTES, Name
from gdp.requests import Backoff, Requests
from gdp.rib.outbox import OutgoingStatement
from gdp.rib.watches import WATCHED_S, Asker, Watches
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.domain import Policy

_CHANGES: Final = Backoff(0.3, 0.6)
_CHANGE_TRIES: Final = 3  # nothing acknowledges a change


@dataclass(slots=True)
class _Kept:
    record: EndpointRecord
    member: Membership
    expires_s: float


class RibEndpoints:
    """Endpoint records of one RIB.

    Args:
        push: sends the record of a switch of this domain to the other RIBs.

    Attributes:
        records: those of this domain's switches, which its RIBs equalise.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        push: Callable[[Name], None],
        watches: int = RIB_WATCHES_MAX,
        maximum: int = ENDPOINT_RECORDS_MAX,
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._push = push
        self._maximum = maximum
        self._kept: dict[Name, _Kept] = {}
        self._ends = DueQueue[Name]()
        self.records = SyncSet[int](lambda sequence: sequence)
        self._of_others = 0  # records of other domains
        self._watches = Watches(watches)
        self._record_paces = TokenBuckets(*ENDPOINT_RECORDS_RATE)
        self._query_paces = TokenBuckets(*ENDPOINT_QUERIES_RATE)
        self._changes = Requests[Name]()  # for watchers, by switch
        self._out: list[OutgoingStatement] = []

    def __len__(self) -> int:
        return len(self._kept)

    def item_of(self, name: Name, now_s: float) -> bytes | None:
        """Return the item of a kept record, or None."""
        kept = self._kept.get(name)
        left_s = 0.0 if kept is None else kept.expires_s - now_s
        return None if kept is None or left_s < LEASE_MIN_S else item_of(kept.record.wire, left_s)

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
            self._push(kept.record.name)

    def receive_item(self, item: bytes, now: Timestamps) -> None:
        """Keep a record that a proven RIB of this domain sent; it goes no further.

        Raises:
            StatementError: it is refused; an older one raises nothing.
        """
        wire, left_s = record_in(item)
        try:
            self._keep(parse(wire), now, min(left_s, ENDPOINT.lease_s))
        except StatementError as error:
            if error.reason is not DropReason.STALE:
                raise

    def _keep(self, statement: Statement, now: Timestamps, lease_s: float = ENDPOINT.lease_s) -> _Kept:
        known = self._kept.get(statement.signer)
        if known is not None and known.record.wire == statement.wire:  # renewed
            self._check(known, now)
            known.expires_s = max(known.expires_s, now.mono_s + lease_s)
            self._ends.put(known.record.name, known.expires_s)
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
        kept = self._kept[record.name] = _Kept(record, member, now.mono_s + lease_s)
        self._ends.put(record.name, kept.expires_s)
        if is_of_other:
            self.records.remove(record.name)
        else:
            self.records.put(record.name, record.sequence)
        self._changes.start(record.name, now.mono_s)
        self._send_change(kept, now.mono_s)
        return kept

    def _send_change(self, kept: _Kept, now_s: float) -> None:
        name = kept.record.name
        self._tell(kept, now_s)
        self._changes.sent(name, now_s, _CHANGES)
        if self._changes.tries(name) >= _CHANGE_TRIES:
            self._changes.cancel(name)

    def _check(self, kept: _Kept, now: Timestamps) -> None:
        self._policy.check_member(kept.member, now.unix_s)
        if kept.record.until_unix_s < now.unix_s:
            raise StatementError(DropReason.EXPIRED, "endpoint record")

    def handle_query(self, query: SyncMessage, member: Membership, now: Timestamps) -> None:
        """Respond to a proven switch with the records that it lacks, and watch them for it.

        Raises:
            StatementError: it may not ask, or asks too often; QUOTA after the response, there are too many watches.
        """
        if not member.role.is_switch:
            raise StatementError(DropReason.NOT_DELEGATED, "only switches ask for endpoints")
        if query.of != ENDPOINTS or len(query.lacking) > ENDPOINT_NAMES_MAX:
            raise StatementError(DropReason.MALFORMED, "a switch's query for endpoints")
        if not self._query_paces.spend(member.name, now.mono_s):
            raise StatementError(DropReason.QUOTA, "queries for endpoints")
        asker = Asker.of(member)
        lacked: list[bytes] = []
        refused: StatementError | None = None
        for prefix, line in query.lacking:
            name = Name(prefix.ljust(NAME_BYTES, b"\0"))  # a shorter one is of no switch
            kept = self._kept.get(name)
            if kept is not None and kept.record.sequence > rank_in(line) and self._may_tell(kept, asker):
                lacked += [item_of(kept.record.wire, kept.expires_s - now.mono_s)] if self._is_valid(kept, now) else []
            try:
                self._watches.add(name, asker, now.mono_s + WATCHED_S)
            except StatementError as error:
                refused = error  # without a watch it learns changes by its next query
        for page in list(pages(lacked)) or [()]:
            self._respond(member.name, page)
        if refused is not None:
            raise refused

    def recheck(self, now: Timestamps) -> None:
        """Drop records whose membership is no longer valid: a certificate was revoked."""
        for name, kept in list(self._kept.items()):
            if not self._is_valid(kept, now):
                self._drop(name)

    def handle_timer(self, now: Timestamps) -> None:
        """Drop records that were not renewed, and send changes once more to their watchers."""
        for name in self._ends.poll_due(now.mono_s):
            self._drop(name)
        self._watches.expire(now.mono_s)
        for name in self._changes.poll_due(now.mono_s):
            known = self._kept.get(name)
            if known is not None and self._is_valid(known, now):
                self._send_change(known, now.mono_s)
            else:
                self._changes.cancel(name)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return earliest(self._changes.next_due(), self._ends.next_due())

    def poll_statements(self) -> list[OutgoingStatement]:
        """Return, once, the statements to send."""
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
        self._ends.discard(name)
        self.records.remove(name)

    @staticmethod
    def _may_tell(kept: _Kept, asker: Asker) -> bool:
        """Return whether an asker may receive a record: endpoints stay within the domain of their switch."""
        return kept.member.domain == asker.domain and kept.member.name != asker.name

    def _tell(self, kept: _Kept, now_s: float) -> None:
        item = item_of(kept.record.wire, kept.expires_s - now_s)
        for asker in self._watches.watchers(kept.record.name, now_s):
            if self._may_tell(kept, asker):
                self._respond(asker.name, (item,))

    def _respond(self, to: Name, items: tuple[bytes, ...] = (), refused: DropReason | None = None) -> None:
        """Send items, and request what is newer than the receiver's own record here."""
        own = self._kept.get(to)
        line = b"" if own is None else line_of(to, own.record.sequence)
        response = SyncMessage(of=ENDPOINTS, items=items, lacking=((to, line),), refused=refused)
        wire = self._identity.signed(response)
        self._out.append(OutgoingStatement(to, Kind.RIB_ANSWER, wire))
