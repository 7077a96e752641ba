"""Trust policy of a domain: which domains it trusts, and through which its traffic may pass.

Sans-I/O. Source: docs/explanation/design.md, section 5. Tiers are for finding names; trust is not inherited along them.
A domain trusts the roots that its own operator configured, and no others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final

from gdp.crypto.certificates import Membership, Root, Unverified
from gdp.crypto.schema import CERTIFICATE
from gdp.crypto.statements import Statement
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name
from gdp.trust.audit import AuditTrail
from gdp.trust.lru import Lru
from gdp.trust.revocations import Revocations

MEMBERS_REMEMBERED: Final = 4_096


class Policy:
    """The trust decisions of one domain.

    Args:
        own: the root of the domain that this node belongs to.
        trusted: roots of other domains whose members may advertise, attach and carry traffic here.
        transit: domains through which this domain lets its traffic pass; all trusted ones if not given.
        diagnostics: domains whose members get whole diagnostic replies; others but our own get latency only.
        remembered: how many verified memberships to cache.

    Raises:
        LocalError: ``transit`` or ``diagnostics`` names a domain that is not trusted.
    """

    def __init__(
        self,
        own: Root,
        trusted: Iterable[Root] = (),
        transit: Iterable[Name] | None = None,
        *,
        diagnostics: Iterable[Name] = (),
        remembered: int = MEMBERS_REMEMBERED,
    ) -> None:
        roots = {root.domain: root for root in (own, *trusted)}
        self.own: Final = own.domain
        self.audit: Final = AuditTrail()  # of the node whose policy this is
        self.roots: Mapping[Name, Root] = MappingProxyType(roots)
        self.transit: Final = frozenset(roots if transit is None else {own.domain, *transit})
        if not self.transit <= roots.keys():
            raise LocalError("transit goes through trusted domains only")
        self.diagnostics: Final = frozenset({own.domain, *diagnostics})
        if not self.diagnostics <= roots.keys():
            raise LocalError("diagnostics are for members of trusted domains only")
        self.revoked: Final = Revocations(_keys_of(roots.values()))
        self._by_issuer = _by_issuer(roots.values())
        self._members: Lru[Membership] = Lru(remembered)

    def trusts(self, domain: Name) -> bool:
        """Return whether members of ``domain`` are trusted here."""
        return domain in self.roots

    def renew_roots(self, roots: Iterable[Root]) -> None:
        """Replace roots of trusted domains by newer ones, such as those with a successor.

        Raises:
            LocalError: a domain that is not trusted, or a root that does not descend from the trusted one; nothing has
                changed then.
        """
        renewed = dict(self.roots)
        for root in roots:
            known = renewed.get(root.domain)
            if known is None:
                raise LocalError(f"{root.label}: another domain than those trusted so far: restart the node")
            if known.key not in [each.key for each in root.lineage]:
                raise LocalError(f"{root.label}: a root that the present one did not vouch for")
            renewed[root.domain] = root
        self.roots = MappingProxyType(renewed)
        self.revoked.trust(_keys_of(renewed.values()))
        self._by_issuer = _by_issuer(renewed.values())

    def verify_membership(self, wire: bytes, unix_s: float) -> Membership:
        """Return the membership if a trusted domain issued it and it is valid now; costs 0.2 ms once, then 2 us.

        Raises:
            StatementError: BAD_CERTIFICATE, WRONG_NAME, WRONG_DOMAIN, EXPIRED or REVOKED.
        """
        entry = hashlib.sha256(wire).digest()
        member = self._members.get(entry)
        if member is None:
            member = self._verified(Unverified.from_wire(wire), unix_s)
            self._members.put(entry, member)
        self.check_member(member, unix_s)
        return member

    def verify_sender(self, statement: Statement, unix_s: float, wire: bytes | None = None) -> Membership:
        """Return the membership in a statement if it is its signer's. The signature is not checked.

        Args:
            wire: of the membership, where it does not stand under ``c``.

        Raises:
            StatementError: MALFORMED, or as ``verify_membership``.
        """
        member = self.verify_membership(CERTIFICATE.read(statement.fields) if wire is None else wire, unix_s)
        if member.name != statement.signer:
            raise StatementError(DropReason.BAD_CERTIFICATE, "the membership is of another node")
        return member

    def check_member(self, member: Membership, unix_s: float) -> None:
        """Return if a membership verified before is still valid.

        Raises:
            StatementError: WRONG_DOMAIN, EXPIRED or REVOKED.
        """
        root = self.roots.get(member.domain)
        if root is None:
            raise StatementError(DropReason.WRONG_DOMAIN, "a domain that is not trusted here")
        if root.key.compressed != member.issuer_key:
            root = self._predecessor(root, member)
        root.validity.check(unix_s, "domain root")
        member.validity.check(unix_s, "membership")
        if self.revoked.has(member.fingerprint, root.key.compressed):
            raise StatementError(DropReason.REVOKED, "membership")

    def _predecessor(self, root: Root, member: Membership) -> Root:
        """Return the root that issued a membership before ``root``; each later root may revoke the membership."""
        for each in reversed(root.lineage):
            if each.key.compressed == member.issuer_key:
                return each
            if self.revoked.has(member.fingerprint, each.key.compressed):
                raise StatementError(DropReason.REVOKED, "membership")
        raise StatementError(DropReason.WRONG_DOMAIN, "issued by a root that is not trusted here")

    def _verified(self, stranger: Unverified, unix_s: float) -> Membership:
        candidates = [
            root
            for root in self._by_issuer.get(stranger.certificate.issuer, ())
            if stranger.certificate.issuer_key_id in (b"", *(each.key_id for each in root.lineage))
        ]
        refusal = StatementError(DropReason.WRONG_DOMAIN, "a domain that is not trusted here")
        for root in candidates:  # more than one only where labels are equal and a tool omitted the key id
            try:
                return stranger.verify(root, unix_s)
            except StatementError as error:
                refusal = error
        raise refusal


def _keys_of(roots: Iterable[Root]) -> list[bytes]:
    return [each.key.compressed for root in roots for each in root.lineage]


def _by_issuer(roots: Iterable[Root]) -> dict[bytes, list[Root]]:
    found: dict[bytes, list[Root]] = {}
    for root in roots:
        found.setdefault(root.distinguished_name, []).append(root)
    return found
