"""Joins from downstream: a switch verifies each before its trees follow it.

Sans-I/O. A join carries the advertisements of a reader and of the publisher (``reader_of``). A refresh renews joins
by number, and its reply names the joins that the neighbour does not know (``joins.py``).
"""

from __future__ import annotations

from typing import Final

from gdp.control.join import Join, JoinRefresh
from gdp.control.neighbour import Neighbour
from gdp.control.pace import ReaderPace
from gdp.crypto.certificates import Role
from gdp.crypto.statements import Statement, StatementType
from gdp.errors import DropReason, StatementError
from gdp.limits import JOINS_RATE
from gdp.sansio import Timestamps
from gdp.switch.forwarding_state import ForwardingState, JoinedBranch
from gdp.switch.multicast import MulticastTrees
from gdp.switch.relocation import Relocations
from gdp.token_bucket import TokenBuckets
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import HEARS
from gdp.trust.verifier import AdvertisementVerifier

_REFRESH_TOKENS: Final = 4.0  # of joins: it renews up to 128 of them, and may cost a reply


class JoinHandler:
    """Handles the joins, leaves and refreshes of neighbouring switches; one that is not valid raises an error."""

    def __init__(self, state: ForwardingState, multicast: MulticastTrees, relocations: Relocations) -> None:
        self._state = state
        self._multicast = multicast
        self._relocations = relocations
        self._paces = TokenBuckets(*JOINS_RATE)

    def handle_join(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle a join, or a leave, which has no lease.

        Raises:
            StatementError: it is not valid, not from a neighbouring switch, or one too many.
        """
        join = Join.from_fields(statement.expect(StatementType.JOIN))
        if not neighbour.role.is_switch or statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a join is from a neighbouring switch")
        self._check(neighbour, statement, now.mono_s, 1.0)
        self._state.neighbours.ports[neighbour.port].receive_join(join, neighbour)
        if join.lease_s > 0:
            advertisement = reader_of(join, self._state.verifier, now)
            if neighbour.role is Role.LEAF and advertisement.switch != neighbour.name:
                raise StatementError(DropReason.THROUGH_LEAF, "a leaf that joins for a node of another switch")
            at = (neighbour.port, neighbour.mac)
            self._state.dependents.record(JoinedBranch(join.topic, join.publisher, at), advertisement)
        if self._multicast.join(join, neighbour, now.mono_s):
            self._relocations.redirect_join(join.topic, join.publisher, neighbour, now.mono_s)

    def handle_refresh(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle a refresh of joins, or the reply to one. Raises ``StatementError``: as ``handle_join``."""
        refresh = JoinRefresh.from_statement(statement)
        if statement.signer != neighbour.name or not (refresh.is_reply or neighbour.role.is_switch):
            raise StatementError(DropReason.UNKNOWN_SENDER, "a refresh is from a neighbouring switch")
        self._check(neighbour, statement, now.mono_s, _REFRESH_TOKENS)
        self._state.neighbours.ports[neighbour.port].receive_join(refresh, neighbour)
        if refresh.is_reply:
            self._multicast.upstream.join_unknown(refresh, neighbour, now.mono_s)
        else:
            self._multicast.refresh(refresh, neighbour, now.mono_s)

    def handle_pace(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle the pace of an attached reader. Raises ``StatementError``: as ``handle_join``."""
        pace = ReaderPace.from_fields(statement.expect(StatementType.PACE))
        if statement.signer != neighbour.name or neighbour.role.is_switch:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a pace is from an attached reader")
        self._check(neighbour, statement, now.mono_s, 1.0)
        self._state.neighbours.ports[neighbour.port].receive_join(pace, neighbour)
        self._multicast.set_pace(pace, neighbour)

    def _check(self, neighbour: Neighbour, statement: Statement, now_s: float, tokens: float) -> None:
        if not self._paces.spend(neighbour.name, now_s, tokens):
            raise StatementError(DropReason.QUOTA, "joins of one neighbour")
        statement.verify(neighbour.key)


def reader_of(join: Join, verifier: AdvertisementVerifier, now: Timestamps) -> Advertisement:
    """Return the reader's advertisement of a join with a lease; the publisher's proves where the join leads.

    Raises:
        StatementError: an advertisement is not valid, or is about something else.
    """
    reader = verifier.verify(join.evidence, now.unix_s)
    if reader.right not in HEARS or reader.name != join.topic:
        raise StatementError(DropReason.NOT_DELEGATED, "a join without a reader's advertisement")
    publisher = verifier.verify(join.proof, now.unix_s)
    proven = publisher.name, publisher.node, publisher.right, publisher.switch, publisher.sequence
    if proven != (join.topic, join.publisher, HEARS[reader.right], join.switch, join.version):
        raise StatementError(DropReason.NOT_DELEGATED, "a join to where the publisher's advertisement is not")
    if (join.path == 2 or join.route) and min(reader.paths, publisher.paths) < 2:
        raise StatementError(DropReason.NOT_DELEGATED, "two paths that reader and publisher do not both ask for")
    return reader
