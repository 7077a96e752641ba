"""Revocation synchronisation: two neighbours reconcile the trusted domains' revocations that they keep.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). ``exchange/anti_entropy.py`` decides what is sent when, by one
set for each trusted domain's root. A revocation is sent as it was signed, and proves itself; each other message counts
once in the session with its neighbour. Only a neighbour that is up gets anything, and bounds are those of its name,
however often its sessions begin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_table import NeighbourTable
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType
from gdp.errors import DropReason, StatementError
from gdp.exchange.anti_entropy import AntiEntropy, SyncPace
from gdp.exchange.sync_message import SyncMessage
from gdp.intervals import Rate
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.revocations import Revocations

# totals are repeated so that a lost flood is repaired; replies are at most 3 Mbit/s
_PACE: Final = SyncPace(total_s=30.0, soon_s=0.5, fetch_s=2.0, reply_s=0.08, reply_bytes=32 << 10, draws=2)
_TAKEN_RATE: Final = Rate(32.0, burst=256.0)  # messages of one neighbour that are verified
_SESSIONS_MAX: Final = 1_024

Say = Callable[[Neighbour, bytes], None]


class RevocationSync:
    """Revocation synchronisation of one node.

    Args:
        say: sends a statement to a neighbour.
        first_sequence: above those of an earlier incarnation; wall-clock milliseconds suffice.
    """

    def __init__(
        self, identity: Identity, revoked: Revocations, neighbours: NeighbourTable, say: Say, first_sequence: int
    ) -> None:
        self._identity = identity
        self._revoked = revoked
        self._table = neighbours
        self._say = say
        self._sequence = first_sequence
        self._exchange = AntiEntropy[tuple[int, Name]](revoked.sets, revoked.item_of, _PACE)
        self._neighbours: dict[tuple[int, Name], Neighbour] = {}
        self._taken = TokenBuckets(*_TAKEN_RATE, _SESSIONS_MAX)
        self._received: dict[tuple[bytes, Name], int] = {}  # by session and name: the highest sequence number

    def neighbour_up(self, neighbour: Neighbour, now_s: float) -> None:
        """Begin with a neighbour that has come up, or has restarted."""
        key = neighbour.port, neighbour.name
        self._neighbours[key] = neighbour
        self._exchange.add_peer(key, neighbour.name, now_s)

    def neighbour_lost(self, neighbour: Neighbour) -> None:
        """Forget a neighbour that is gone."""
        key = neighbour.port, neighbour.name
        if self._neighbours.pop(key, None) is not None:
            self._exchange.remove_peer(key)

    def receive(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Process a neighbour's message.

        Raises:
            StatementError: MALFORMED, UNKNOWN_SENDER, BAD_SIGNATURE, REPLAYED or QUOTA.
        """
        key = neighbour.port, neighbour.name
        if key not in self._neighbours or statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "about revocations, which the neighbour did not sign")
        message = SyncMessage.from_fields(statement.expect(StatementType.SYNC))
        session = self._table.ports[neighbour.port].echo, neighbour.name
        if message.session != session[0] or message.sequence <= self._received.get(session, -1):
            raise StatementError(DropReason.REPLAYED, "about revocations")
        if not self._taken.spend(neighbour.name, now.mono_s):
            raise StatementError(DropReason.QUOTA, "about revocations")
        statement.verify(neighbour.key)
        self._received.pop(session, None)
        self._received[session] = message.sequence
        if len(self._received) > _SESSIONS_MAX:
            del self._received[next(iter(self._received))]
        self._revoked.expire(now.unix_s)
        self._exchange.receive_message(key, message, now.mono_s)
        self._send(now.mono_s)

    def took(self, neighbour: Neighbour, now_s: float) -> None:
        """Note that a neighbour sent a revocation that was missing here; the others get totals after a delay."""
        self._exchange.took((neighbour.port, neighbour.name), now_s)

    def handle_timer(self, now_s: float) -> None:
        """Send what is due."""
        self._exchange.handle_timer(now_s)
        self._send(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._exchange.get_timer()

    def _send(self, now_s: float) -> None:
        for key, message in self._exchange.poll_messages(now_s):
            neighbour = self._neighbours[key]
            for wire in message.items:
                self._say(neighbour, wire)
            if not message.items:
                self._sequence += 1
                counted = replace(message, session=neighbour.echo, sequence=self._sequence)
                self._say(neighbour, counted.to_wire(self._identity.name, self._identity.key))
