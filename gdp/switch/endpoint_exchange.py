"""Endpoint exchange of a switch with its RIB: it publishes its own record, and learns those of other switches.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds) or ``Timestamps``. A record is sent again until a response
states that the RIB keeps it, then each third of its lease. A RIB that is new here receives record and query at once.
The RIB also sends new records of the wanted switches when they come; queries are repeated for losses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from gdp.control.endpoints import ENDPOINT_NAMES_MAX, ENDPOINTS, EndpointRecord, record_in
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.exchange.sync_message import SyncMessage
from gdp.exchange.sync_set import line_of, rank_in
from gdp.intervals import ENDPOINT, RETRY_S
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy

_REPEATS: Final = Backoff(0.3, 4.8)
_RECORD, _QUERY = StatementType.ENDPOINTS, StatementType.SYNC  # what is sent


class Refusal(NamedTuple):
    """Why the RIB refused this switch's record, and the sequence of the one that it keeps instead; 0: none."""

    reason: DropReason
    kept_sequence: int


class EndpointExchange:
    """Endpoint records of one switch's domain.

    Attributes:
        own: this switch's record, or None while it publishes none.
        refusal: of the RIB's last response.
    """

    def __init__(self, identity: Identity, policy: Policy) -> None:
        self._identity = identity
        self._policy = policy
        self._wanted: dict[Name, None] = {}
        self._known: dict[Name, tuple[EndpointRecord, Membership]] = {}
        self._requests = Requests[StatementType]()
        self.own: EndpointRecord | None = None
        self.refusal: Refusal | None = None

    def set_own(self, record: EndpointRecord) -> None:
        """Set this switch's record, which is published instead of the one before.

        Raises:
            StatementError: STALE, its sequence is not higher.
        """
        if self.own is not None and record.sequence <= self.own.sequence:
            raise StatementError(DropReason.STALE, "own endpoint record")
        self.own, self.refusal = record, None
        self._requests.start(_RECORD, float("-inf"))

    def want(self, names: Iterable[Name], now_s: float) -> None:
        """Learn the records of these switches, the first ``ENDPOINT_NAMES_MAX``, and of no others."""
        wanted = dict.fromkeys(list(names)[:ENDPOINT_NAMES_MAX])
        if wanted.keys() - self._wanted.keys():
            self._requests.start(_QUERY, now_s)
        self._wanted = wanted
        if not wanted:
            self._requests.cancel(_QUERY)
        for name in self._known.keys() - wanted.keys():
            del self._known[name]

    def rib_changed(self, now_s: float) -> None:
        """Publish and query again: another RIB is used, or it was restarted."""
        if self.own is not None:
            self._requests.start(_RECORD, now_s)
        if self._wanted:
            self._requests.start(_QUERY, now_s)

    def statements_to_send(self, now_s: float) -> list[bytes]:
        """Return the statements that are due at the RIB."""
        wires = []
        for what in self._requests.poll_due(now_s):
            self._requests.sent(what, now_s, _REPEATS)
            if what is _RECORD and self.own is not None:
                wires.append(self.own.wire)
                continue
            lines = {name: line_of(name, record.sequence) for name, (record, _) in self._known.items()}
            query = SyncMessage(of=ENDPOINTS, lacking=tuple((name, lines.get(name, b"")) for name in self._wanted))
            wires.append(self._identity.signed(query))
        return wires

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next statement, or None."""
        return self._requests.next_due()

    def receive(self, response: SyncMessage, now: Timestamps) -> None:
        """Process a response of the RIB in use.

        Raises:
            StatementError: a record in it is not valid; the others count.
        """
        own = self.own
        if own is not None:
            kept_sequence = next((rank_in(line) for name, line in response.lacking if name == own.name), 0)
            if response.refused is not None:
                self.refusal = Refusal(response.refused, kept_sequence)
                self._requests.answered(_RECORD, now.mono_s + RETRY_S)
            elif kept_sequence == own.sequence:
                self.refusal = None
                self._requests.answered(_RECORD, now.mono_s + ENDPOINT.refresh_s)
            elif not self._requests.tries(_RECORD):
                self._requests.start(_RECORD, now.mono_s)  # the RIB has lost it
        if self._requests.tries(_QUERY):
            self._requests.answered(_QUERY, now.mono_s + RETRY_S)
        refused: StatementError | None = None
        for item in response.items:
            try:
                self._learn(record_in(item)[0], now)
            except StatementError as error:
                refused = error
        if refused is not None:
            raise refused

    def _learn(self, wire: bytes, now: Timestamps) -> None:
        record, member = EndpointRecord.verified(wire, self._policy, now.unix_s)
        if member.domain != self._policy.own or not member.role.is_switch:
            raise StatementError(DropReason.WRONG_DOMAIN, "endpoints of another than a switch of this domain")
        if record.name in self._wanted and record.sequence > self._sequence_of(record.name):
            self._known[record.name] = record, member

    def _sequence_of(self, name: Name) -> int:
        known = self._known.get(name)
        return 0 if known is None else known[0].sequence

    def records(self, now: Timestamps) -> Mapping[Name, EndpointRecord]:
        """Return the records of wanted switches; those void or of a revoked membership are removed."""
        for name, (record, member) in list(self._known.items()):
            try:
                self._policy.check_member(member, now.unix_s)
            except StatementError:
                del self._known[name]
                continue
            if record.until_unix_s < now.unix_s:
                del self._known[name]
        return {name: record for name, (record, _) in self._known.items()}
