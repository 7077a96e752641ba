"""Advertisements and withdrawals of attached nodes: a switch verifies each before it acts on it.

Sans-I/O. An advertisement with a right in ``HEARS`` starts multicast trees, so the switch verifies it here. Any other
is stored, relayed, and verified by the RIB, because those who receive that traffic must find the node.

A node numbers all its advertisements in one sequence, and sends all of them again in each session with a switch. Three
kinds of advertisements are therefore replays: of another incarnation of the node, below the first one of its present
session, and received before.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.control.rib_statements import AdvertiseAck
from gdp.crypto.statements import Statement
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.limits import ADVERTISEMENTS_RATE, ADVERTISEMENTS_WINDOW
from gdp.message.replay import ReplayWindow
from gdp.names import ZERO, Name
from gdp.sansio import Timestamps
from gdp.switch.forwarding_state import AttachedAdvertisement, ForwardingState
from gdp.switch.location_updates import LocationUpdates
from gdp.switch.multicast import MulticastTrees
from gdp.switch.relocation import Relocations
from gdp.switch.rib_client import RibClient
from gdp.switch.unicast import Unicast
from gdp.token_bucket import TokenBuckets
from gdp.trust.advertisement import Advertisement, UnverifiedAdvertisement, Withdrawal
from gdp.trust.audit import Action
from gdp.trust.right import HEARS, Right

_SESSIONS_MAX: Final = 4_096  # more than the neighbours that a switch has
_INCARNATION_BYTES: Final = 8  # at the end of an instance id
_REPORT_INTERVAL_S: Final = 1.0


class _Session:
    """The advertisements that came in one session of a node."""

    __slots__ = ("first", "reported_s", "window")

    def __init__(self, first: int) -> None:
        self.first = first
        self.reported_s = float("-inf")  # when the node last received a report that it is behind
        self.window = ReplayWindow(ADVERTISEMENTS_WINDOW)


class AdvertisementHandler:
    """Handles the advertisements of attached nodes."""

    def __init__(
        self,
        state: ForwardingState,
        *,
        multicast: MulticastTrees,
        unicast: Unicast,
        rib_client: RibClient,
        locations: LocationUpdates,
        relocations: Relocations,
    ) -> None:
        self._state = state
        self._multicast = multicast
        self._unicast = unicast
        self._rib_client = rib_client
        self._locations = locations
        self._relocations = relocations
        self._paces = TokenBuckets(*ADVERTISEMENTS_RATE)
        self._sessions: OrderedDict[bytes, _Session] = OrderedDict()  # by the node's nonce

    def receive_advertisement(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle an advertisement of an attached node; the node receives an AdvertiseAck in either case.

        Raises:
            StatementError: it is not valid, or is not the node's newest, or the node sends too many.
        """
        self._check_pace(neighbour, now.mono_s)
        if statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "an advertisement that its signer did not send")
        try:
            advertisement = self._state.verifier.verify_statement(statement, now.unix_s)
            if advertisement.switch != self._state.me:
                raise StatementError(DropReason.NOT_FOR_US, "the RtCert names another switch")
        except StatementError as error:
            self._refuse(neighbour, statement, error)
            raise
        self._check_fresh(neighbour, advertisement, now.mono_s)
        at = (neighbour.port, neighbour.mac)
        holder = AttachedAdvertisement(advertisement.name, advertisement.node, at)
        newest = self._sequence_of(advertisement.name, neighbour)
        if advertisement.sequence < newest:
            self._acknowledge(neighbour, advertisement.name, DropReason.STALE, newest)
            raise StatementError(DropReason.STALE, "an advertisement that its signer has renewed")
        if advertisement.right in HEARS:
            cache = self._state.resolver.cache
            try:
                self._multicast.add_reader(advertisement, at, cache.of(advertisement.name, now.mono_s), now.mono_s)
            except StatementError as error:
                self._refuse(neighbour, statement, error)
                raise
            self._state.dependents.record(holder, advertisement)
            for location in cache.of(advertisement.name, now.mono_s):
                self._locations.send_to_reader(at, advertisement.right, location, now.mono_s)
        # no RIB sends an AdvertiseAck to a node that has moved
        is_alone = self._rib_client.rib is None and advertisement.previous != ZERO
        if advertisement.right is Right.READ or is_alone:
            self._acknowledge(neighbour, advertisement.name, None, advertisement.sequence)
        if advertisement.right is not Right.READ:
            known = self._state.attached.get(advertisement.name, advertisement.node)
            try:
                self._state.attached.put(advertisement, *at, now.mono_s)
            except StatementError as error:
                self._refuse(neighbour, statement, error)
                raise
            self._state.dependents.record(holder, advertisement)
            if known is None or (known.port, known.mac) != at:
                self._state.policy.audit.record(
                    Action.ACCEPTED, "name", who=advertisement.node.to_text(), about=advertisement.name.to_text()
                )
                self._unicast.remove(advertisement.name)
            self._unicast.release(advertisement.name, now.mono_s)
            self._multicast.publisher_attached(advertisement, now.mono_s)
        self._relocations.arrived(advertisement, now.mono_s)
        self._rib_client.send_due(now.mono_s)

    def _check_pace(self, neighbour: Neighbour, now_s: float) -> None:
        if not self._paces.spend(neighbour.name, now_s):
            # No response is sent: that would cost work, too.
            raise StatementError(DropReason.QUOTA, "advertisements of one neighbour")

    def _check_fresh(self, neighbour: Neighbour, advertisement: Advertisement, now_s: float) -> None:
        """Record a verified advertisement; a neighbour that is far behind receives, now and then, by how much.

        Raises:
            StatementError: REPLAYED, it is of another incarnation or session of the node, or came before.
        """
        if (
            advertisement.incarnation.to_bytes(_INCARNATION_BYTES, "big")
            != neighbour.incarnation_id[-_INCARNATION_BYTES:]
        ):
            raise StatementError(DropReason.REPLAYED, "an advertisement of another incarnation of its signer")
        session = self._sessions.get(neighbour.nonce)
        if session is None:
            session = self._sessions[neighbour.nonce] = _Session(advertisement.sequence)
            if len(self._sessions) > _SESSIONS_MAX:
                self._sessions.popitem(last=False)
        if advertisement.sequence < session.first or session.window.is_finished(advertisement.sequence):
            if (
                advertisement.sequence <= session.window.top - ADVERTISEMENTS_WINDOW
                and now_s >= session.reported_s + _REPORT_INTERVAL_S
            ):
                # The advertisement may be the node's own; the node sends nothing newer unless it receives this report.
                session.reported_s = now_s
                self._acknowledge(neighbour, advertisement.name, DropReason.STALE, session.window.top)
            raise StatementError(DropReason.REPLAYED, "an advertisement")
        session.window.finish(advertisement.sequence)
        self._sessions.move_to_end(neighbour.nonce)

    def _sequence_of(self, name: Name, neighbour: Neighbour) -> int:
        """Return the highest sequence number among an attached node's advertisements of a name here, or -1."""
        attachment = self._state.attached.get(name, neighbour.name)
        reading = self._state.readers.advertisement_of(name, (neighbour.port, neighbour.mac))
        known = [reading] if attachment is None else [reading, attachment.advertisement]
        return max((advertisement.sequence for advertisement in known if advertisement is not None), default=-1)

    def _refuse(self, neighbour: Neighbour, statement: Statement, error: StatementError) -> None:
        """Send an attached node an AdvertiseAck that rejects its advertisement."""
        try:
            body = UnverifiedAdvertisement.from_statement(statement)
        except StatementError:
            return  # not even an advertisement: the caller counts it
        who, about, reason = neighbour.name.to_text(), body.subject.name.to_text(), error.reason.label
        self._state.policy.audit.record(Action.REFUSED, "name", who=who, about=about, reason=reason)
        self._acknowledge(neighbour, body.subject.name, error.reason, body.sequence)

    def _acknowledge(self, neighbour: Neighbour, name: Name, refused: DropReason | None, sequence: int) -> None:
        ack = AdvertiseAck(name, neighbour.name, refused, sequence)
        wire = self._state.identity.signed(ack)
        self._state.outbox.send_to_neighbour(neighbour, Kind.ADVERTISE_ACK, wire)

    def receive_withdrawal(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle a withdrawal.

        Raises:
            StatementError: it is not valid, or is older than the present advertisement, or the node sends too many.
        """
        self._check_pace(neighbour, now.mono_s)
        withdrawal = Withdrawal.received(statement, now.unix_s)
        if statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a withdrawal that its maker did not bring")
        statement.verify(neighbour.key)
        name, right = withdrawal.name, withdrawal.right
        if withdrawal.sequence <= self._sequence_of(name, neighbour):
            raise StatementError(DropReason.STALE, "a withdrawal of what was advertised again")
        if right in HEARS:
            self._multicast.remove_reader(name, (neighbour.port, neighbour.mac))
        if right is not Right.READ and self._state.attached.remove(name, neighbour.name) is not None:
            self._unicast.remove(name)
            self._rib_client.relay(statement.wire, now.mono_s)
