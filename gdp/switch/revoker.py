"""Taking certificates back: pass the word on, and close what they opened here.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A revocation proves itself, so it is passed to every neighbour of every domain, once; a neighbour that comes up is told
all that is known. What a revoked certificate had opened ends at once: attachments, readers, and, unless the switch
below shows another reader within ``GRACE_S``, the branches that rested on it. A revoked neighbour's next hello is
refused, so that it is gone when it has been silent for long enough.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from gdp.control.greeter import Greeter
from gdp.control.neighbour import Neighbour
from gdp.crypto.statements import Statement
from gdp.effects import Instant
from gdp.errors import StatementError
from gdp.frame.kinds import Kind
from gdp.names import Name
from gdp.switch.attached import Attached
from gdp.switch.evidence import Evidence
from gdp.switch.outbox import Outbox
from gdp.switch.places import Places
from gdp.switch.planter import Planter
from gdp.switch.unicast import Unicast
from gdp.trust.audit import Action
from gdp.trust.claim import Claim
from gdp.trust.verifier import ClaimVerifier

__all__ = ["Revoker"]

GRACE_S: Final = 0.5
TOLD_MAX: Final = 4_096  # revocations that a new neighbour is told of


class Revoker:
    """Spreads and applies revocations at one switch."""

    def __init__(
        self,
        verifier: ClaimVerifier,
        greeter: Greeter,
        attached: Attached,
        planter: Planter,
        unicast: Unicast,
        places: Places,
        evidence: Evidence,
        outbox: Outbox,
    ) -> None:
        self._verifier = verifier
        self._greeter = greeter
        self._attached = attached
        self._planter = planter
        self._unicast = unicast
        self._places = places
        self._evidence = evidence
        self._outbox = outbox
        self._told: OrderedDict[bytes, bytes] = OrderedDict()  # fingerprint -> statement

    def __len__(self) -> int:
        return len(self._told)

    def take(self, statement: Statement, neighbour: Neighbour | None, now: Instant) -> list[Name]:
        """Take a revocation, from a neighbour or from this node's operator; return the topics that lost all readers.

        Raises:
            StatementError: it does not hold, or there is no room for it.
        """
        revocation = self._verifier.revoke(statement.wire, now.unix_s)
        if revocation is None:
            return []
        issuer, about = revocation.issuer.name.to_text(), revocation.fingerprint.hex()
        self._verifier.policy.audit.note(Action.REVOKED, "certificate", who=issuer, about=about)
        self._told[statement.fingerprint] = statement.wire
        while len(self._told) > TOLD_MAX:
            self._told.popitem(last=False)
        for other in self._greeter.all_up():
            if neighbour is None or (other.port, other.name) != (neighbour.port, neighbour.name):
                self._outbox.say(other, Kind.REVOKE, statement.wire)
        return self._apply(now)

    def tell_all(self, neighbour: Neighbour) -> None:
        """Tell a neighbour that has come up what has been taken back."""
        for wire in self._told.values():
            self._outbox.say(neighbour, Kind.REVOKE, wire)

    def _apply(self, now: Instant) -> list[Name]:
        for attachment in self._attached.all():
            if not self._holds(attachment.claim, now):
                self._attached.remove(attachment.claim.name, attachment.claim.node)
                self._unicast.forget(attachment.claim.name)
        for place in self._places.all():
            if not self._evidence.still_holds(place, now):
                self._places.remove(place.name, place.advertiser, now.mono_s)
                self._planter.publisher_gone(place.name, place.advertiser)
                self._unicast.forget(place.name)
        orphaned = []
        for topic, at, claim in self._planter.claims():
            if not self._holds(claim, now) and self._planter.remove_reader(topic, at):
                orphaned.append(topic)
        self._planter.doubt(lambda evidence: self._proves(evidence, now), now.mono_s + GRACE_S, now.mono_s)
        return orphaned

    def _holds(self, claim: Claim, now: Instant) -> bool:
        try:
            self._verifier.recheck(claim, now.unix_s)
        except StatementError:
            return False
        return True

    def _proves(self, evidence: bytes, now: Instant) -> bool:
        try:
            self._verifier.verify(evidence, now.unix_s)
        except StatementError:
            return False
        return True
