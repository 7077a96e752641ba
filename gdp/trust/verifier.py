"""Verification of advertisements: every proof, in the order that costs an attacker most and this node least.

Sans-I/O; it caches what it verified, within bounds. Source: docs/explanation/design.md, section 5. Free checks come
first (form, hash, lease), then the signer (membership, signature), and only for a proven member the rest. A new
advertisement costs two signature checks. A refreshed one costs one, since known certificates are cached by digest. Time
and revocation are checked every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from gdp.crypto.certificates import Membership
from gdp.crypto.statements import Statement, check_sequence, parse
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, StatementError
from gdp.intervals import LEASE_MAX_S, LEASE_MIN_S
from gdp.trust.adcert import AdCertCache, Chain
from gdp.trust.advertisement import MS, Advertisement, UnverifiedAdvertisement
from gdp.trust.domain import Policy
from gdp.trust.revocations import Revocations
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCertCache

ADCERTS_REMEMBERED: Final = 16_384
RTCERTS_REMEMBERED: Final = 4_096


class AdvertisementVerifier:
    """Verifies advertisements under a policy.

    Args:
        policy: the trusted domains; shared with every verifier of memberships, so that a revocation reaches all.
        allow_unowned: whether any member may advertise a name without an owner.
        adcerts_remembered: how many verified AdCerts to cache, about 1 kB each.
        rtcerts_remembered: how many verified RtCerts to cache.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        allow_unowned: bool = False,
        adcerts_remembered: int = ADCERTS_REMEMBERED,
        rtcerts_remembered: int = RTCERTS_REMEMBERED,
    ) -> None:
        self.policy: Final = policy
        self._allow_unowned = allow_unowned
        self._adcerts = AdCertCache(adcerts_remembered)
        self._rtcerts = RtCertCache(rtcerts_remembered)

    @property
    def revoked(self) -> Revocations:
        """Return the revocations that this node has received."""
        return self.policy.revoked

    def verify(self, wire: bytes, unix_s: float) -> Advertisement:
        """Return the advertisement if all of it is valid now. The RIB decides whether its sequence is news.

        Raises:
            StatementError: with the reason; never another exception, whatever the bytes.
        """
        return self.verify_statement(parse(wire), unix_s)

    def verify_statement(self, statement: Statement, unix_s: float) -> Advertisement:
        """Return the advertisement in a parsed statement if all of it is valid now.

        Raises:
            StatementError: with the reason.
        """
        body = UnverifiedAdvertisement.from_statement(statement)
        if not LEASE_MIN_S * MS <= body.lease_ms <= LEASE_MAX_S * MS:
            raise StatementError(DropReason.LEASE_BOUNDS, f"{body.lease_ms} ms")
        check_sequence(body.sequence, unix_s)
        member = self.policy.verify_sender(statement, unix_s, body.membership)
        statement.verify(member.key)
        rtcert = self._rtcerts.verified(body.rtcert, member.name, member.key)
        chain = self._chain(body.subject, body.right, body.chain, member)
        advertisement = body.verified(member, chain, rtcert, statement.wire)
        self._check_evidence(advertisement, unix_s)
        return advertisement

    def recheck(self, advertisement: Advertisement, unix_s: float) -> None:
        """Return if an advertisement verified before is still valid; costs a few microseconds.

        Raises:
            StatementError: EXPIRED, REVOKED or WRONG_DOMAIN.
        """
        self.policy.check_member(advertisement.member, unix_s)
        self._check_evidence(advertisement, unix_s)

    def verify_right(
        self, subject: Subject, right: Right, chain: Sequence[bytes], member: Membership, unix_s: float
    ) -> None:
        """Return if a member has a right on a name now.

        Args:
            chain: the AdCerts from the owner to the member; empty where it owns the name.

        Raises:
            StatementError: NOT_DELEGATED, BAD_SIGNATURE, EXPIRED, REVOKED or MALFORMED.
        """
        self._chain(subject, right, chain, member).check(right, unix_s, self.revoked)

    def _chain(self, subject: Subject, right: Right, chain: Sequence[bytes], member: Membership) -> Chain:
        """Return the proof that the member may act on the name, its links verified."""
        if right is Right.ATTACH and subject.name != member.name:
            raise StatementError(DropReason.NOT_DELEGATED, "a node attaches under its own name only")
        if chain:
            return Chain.traverse(chain, subject, member.subject, self._adcerts)
        owns = subject.owner_key == member.key.compressed or (not subject.owner_key and self._allow_unowned)
        if not owns:
            raise StatementError(DropReason.NOT_DELEGATED, "no delegation from the owner")
        return Chain(())

    def _check_evidence(self, advertisement: Advertisement, unix_s: float) -> None:
        """Reject evidence that has expired or is revoked, apart from the membership."""
        advertisement.rtcert.validity.check(unix_s, "RtCert")
        if self.revoked.has(advertisement.rtcert.fingerprint, advertisement.member.key.compressed):
            raise StatementError(DropReason.REVOKED, "RtCert")
        advertisement.chain.check(advertisement.right, unix_s, self.revoked)
