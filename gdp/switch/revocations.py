"""Revocations at a switch: it verifies them, closes what depends on them, and forwards them to affected nodes.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A revocation of a trusted domain's root goes to every neighbour, once; neighbours compare their sets by digests
(``control/revocation_sync.py``). A revocation of an owner is accepted where a certificate of that owner is stored. It
goes on from there to the neighbours, and is dropped by those that store none. A revocation that the operator submits
also goes to the RIB. The RIB sends it to every node that advertised, watches or queried the name, in every tier.

What a revoked certificate had opened ends at once: attachments, readers, and the branches that depend on it. A branch
stays if the downstream switch sends another reader's evidence within ``GRACE_S``. The session with a revoked neighbour
is closed.
"""

from __future__ import annotations

from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.revocation_sync import RevocationSync
from gdp.crypto.statements import Statement, StatementType
from gdp.errors import StatementError
from gdp.frame.codec import Kind
from gdp.intervals import PACE_S
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.sansio import Timestamps
from gdp.switch.forwarding_state import AttachedAdvertisement, ForwardingState, JoinedBranch, KnownLocation
from gdp.switch.multicast import MulticastTrees
from gdp.switch.unicast import Unicast
from gdp.trust.advertisement import Advertisement
from gdp.trust.audit import Action
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import OPERATOR

GRACE_S: Final = 0.5
_SUBMITTED: Final = Backoff(0.3, 60.0)  # of a revocation that the operator submitted
_PER_TICK: Final = 4


class RevocationHandler:
    """Handles, applies and distributes revocations at one switch.

    One that is not valid, concerns nothing here, or exceeds a quota raises ``StatementError``.

    Args:
        first_sequence: above those of an earlier incarnation.

    Attributes:
        sync: comparison of revocations with the neighbours.
    """

    def __init__(
        self,
        state: ForwardingState,
        hello_protocol: HelloProtocol,
        multicast: MulticastTrees,
        unicast: Unicast,
        first_sequence: int,
    ) -> None:
        self._state = state
        self._revoked = state.policy.revoked
        self._hello_protocol = hello_protocol
        self._multicast = multicast
        self._unicast = unicast
        self.sync = RevocationSync(
            state.identity, self._revoked, state.neighbours, self._send_to_reconcile, first_sequence
        )
        self._handed_in: dict[bytes, tuple[Revocation, bytes]] = {}  # of owners, with the wire form, by fingerprint
        self._requests = Requests[bytes]()  # to the RIB, by fingerprint
        self._next_send_s = float("-inf")
        self._sent_to: Name | None = None  # the RIB that received the operator's revocations

    def receive_revocation(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Handle a revocation from a neighbour."""
        revocation = self._revoked.receive_revocation(statement, neighbour.name, now, self._state.dependents.has_issuer)
        if revocation is not None:
            self._spread(revocation, statement, neighbour, now)

    def receive_sync(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Take part in the comparison of revocations; other neighbours get one that was missing here by digests."""
        if statement.type is not StatementType.REVOKE:
            self.sync.receive(neighbour, statement, now)
            return
        revocation = self._revoked.receive_revocation(statement, neighbour.name, now, self._state.dependents.has_issuer)
        if revocation is not None:
            self.sync.took(neighbour, now.mono_s)
            self._apply(revocation, now)

    def receive_from_rib(self, statement: Statement, rib: Name, now: Timestamps) -> None:
        """Handle a revocation that a RIB sent."""
        revocation = self._revoked.receive_revocation(statement, rib, now, self._state.dependents.has_issuer)
        if revocation is not None:
            self._spread(revocation, statement, None, now)

    def hand_in(self, statement: Statement, now: Timestamps) -> None:
        """Handle a revocation from this node's operator, for any issuer."""
        revocation = self._revoked.receive_revocation(statement, OPERATOR, now, self._state.dependents.has_issuer)
        issued = revocation or Revocation.read(statement)
        if not self._revoked.is_root(issued.issuer.owner_key):
            self._handed_in[statement.fingerprint] = issued, statement.wire
            if statement.fingerprint not in self._requests:
                self._requests.start(statement.fingerprint, now.mono_s)
        if revocation is not None:
            self._spread(revocation, statement, None, now)

    def due_for_rib(self, rib: Name, now_s: float) -> list[bytes]:
        """Return the few revocations of the operator that are due at this RIB; expired ones are removed.

        A RIB keeps one only while a name that it concerns is stored or watched there, and acknowledges none. So each is
        sent again and again: a later user of the name receives it.
        """
        if rib != self._sent_to:
            self._sent_to = rib
            self._requests.start_all(now_s)
        if now_s < self._next_send_s:
            return []
        wires = []
        for fingerprint in self._requests.poll_due(now_s, _PER_TICK):
            self._next_send_s = now_s + PACE_S
            revocation, wire = self._handed_in[fingerprint]
            if self._revoked.has(revocation.fingerprint, revocation.issuer.owner_key):
                self._requests.sent(fingerprint, now_s, _SUBMITTED)
                wires.append(wire)
            else:
                self._requests.cancel(fingerprint)
                del self._handed_in[fingerprint]
        return wires

    def next_due_for_rib(self) -> float | None:
        """Return the monotonic second at which the next revocation is due at the RIB, or None."""
        due_s = self._requests.next_due()
        return None if due_s is None else max(due_s, self._next_send_s)

    def _send_to_reconcile(self, neighbour: Neighbour, wire: bytes) -> None:
        self._state.outbox.send_to_neighbour(neighbour, Kind.REVOKED, wire)

    def _spread(self, revocation: Revocation, statement: Statement, origin: Neighbour | None, now: Timestamps) -> None:
        for other in self._state.neighbours.all_up():
            if origin is None or (other.port, other.name) != (origin.port, origin.name):
                self._state.outbox.send_to_neighbour(other, Kind.REVOKE, statement.wire)
        self._apply(revocation, now)

    def _apply(self, revocation: Revocation, now: Timestamps) -> None:
        """Close what carries the revoked certificate; topics that lose all readers here are no longer watched."""
        issuer, about = revocation.issuer.name.to_text(), revocation.fingerprint.hex()
        self._state.policy.audit.record(Action.REVOKED, "certificate", who=issuer, about=about)
        for holder in self._state.dependents.resting_on(revocation.fingerprint):
            if isinstance(holder, AttachedAdvertisement):
                self._close_advertisement(holder, now)
            elif isinstance(holder, KnownLocation):
                self._close_place(holder, now)
            else:
                self._doubt(holder, now)
        self._hello_protocol.recheck(revocation.fingerprint, now)

    def _close_advertisement(self, holder: AttachedAdvertisement, now: Timestamps) -> None:
        attachment = self._state.attached.get(holder.name, holder.node)
        if attachment is not None and not self._still_holds(attachment.advertisement, now):
            self._state.attached.remove(holder.name, holder.node)
            self._unicast.remove(holder.name)
        advertisement = self._state.readers.advertisement_of(holder.name, holder.at)
        if advertisement is None or self._still_holds(advertisement, now):
            return
        self._multicast.remove_reader(holder.name, holder.at)
        for tree in self._state.trees.of_topic(holder.name):
            self._doubt(JoinedBranch(tree.topic, tree.publisher, holder.at), now)

    def _close_place(self, holder: KnownLocation, now: Timestamps) -> None:
        place = self._state.resolver.cache.get(holder.name, holder.advertiser)
        if place is None or place.proof is None:
            return
        if not self._still_holds(place.proof, now):
            self._state.resolver.receive_removal(place.name, place.advertiser, now.mono_s)
            self._multicast.publisher_gone(place.name, place.advertiser)
            self._unicast.remove(place.name)

    def _doubt(self, branch: JoinedBranch, now: Timestamps) -> None:
        proves = lambda evidence: self._proves(evidence, now)  # noqa: E731
        self._multicast.invalidate_evidence(
            branch.topic, branch.publisher, branch.at, proves, now.mono_s + GRACE_S, now.mono_s
        )

    def _still_holds(self, advertisement: Advertisement, now: Timestamps) -> bool:
        """Return whether the certificates of a verified advertisement are still valid."""
        try:
            self._state.verifier.recheck(advertisement, now.unix_s)
        except StatementError:
            return False
        return True

    def _proves(self, evidence: bytes, now: Timestamps) -> bool:
        try:
            self._state.verifier.verify(evidence, now.unix_s)
        except StatementError:
            return False
        return True
