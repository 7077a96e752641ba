"""AdCert: an owner, or a delegate of the owner, permits a node to act on a name.

Sans-I/O. Source: FogROS G, section on advertisements; docs/explanation/design.md, section 5. A chain leads from the
owner's key to the acting node. Each link is signed by the key that the link before it names. A link may only narrow the
rights, and needs the permission of the link before it.

::

    owner's key ==AdCert==> node A (may delegate) ==AdCert==> node B
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.keys import KEY_BYTES, PublicKey, SigningKey
from gdp.crypto.schema import FLAG, NAME, STATEMENT, Body, Keyed, many, octets
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.crypto.subject import NAMED_SUBJECT, Subject
from gdp.crypto.validity import VALIDITY, Validity
from gdp.errors import DropReason, StatementError
from gdp.limits import CHAIN_MAX
from gdp.names import Name
from gdp.trust.lru import Lru
from gdp.trust.revocations import Revocations
from gdp.trust.right import RIGHTS, Right

CHAIN: Final = many(STATEMENT, CHAIN_MAX, is_cut=False)  # AdCerts from the owner on, signed statements


@dataclass(frozen=True, slots=True, kw_only=True)
class AdCert(Body):
    """One link of a chain.

    Args:
        subject: the name that it is about.
        issuer: its signer: the name itself stands for its owner, otherwise the node one link up.
        delegate_key: that node's key, 33 bytes.
        fingerprint: SHA-256 of the signed part, for revocation.
    """

    TYPE = StatementType.ADCERT
    subject: Annotated[Subject, NAMED_SUBJECT]
    issuer: Name
    delegate: Annotated[Name, Keyed("to", NAME)]
    delegate_key: Annotated[bytes, Keyed("key", octets(KEY_BYTES))]
    rights: Annotated[frozenset[Right], Keyed("rights", RIGHTS)]
    validity: Annotated[Validity, VALIDITY]
    may_delegate: Annotated[bool, Keyed("more", FLAG)]
    fingerprint: bytes = b""

    @staticmethod
    def make(
        key: SigningKey,
        issuer: Name,
        subject: Subject,
        delegate: Subject,
        rights: Collection[Right],
        validity: Validity,
        *,
        may_delegate: bool = False,
    ) -> bytes:
        """Return the signed statement.

        Args:
            key: the issuer's: the owner's key where ``issuer`` is the name itself.
            issuer: the subject's own name, or the node that is valid the link above.
            rights: of publish, serve, call and read.

        Raises:
            LocalError: rights that cannot be delegated.
        """
        link = AdCert(
            subject=subject,
            issuer=issuer,
            delegate=delegate.name,
            delegate_key=delegate.owner_key,
            rights=frozenset(rights),
            validity=validity,
            may_delegate=may_delegate,
        )
        return link.to_wire(issuer, key)

    @classmethod
    def given_by(cls, statement: Statement) -> dict[str, object]:
        """Return issuer and fingerprint."""
        return {"issuer": statement.signer, "fingerprint": statement.fingerprint}


class AdCertCache:
    """Cache of the AdCerts whose signatures were verified, so that a refreshed advertisement verifies none again."""

    def __init__(self, maximum: int) -> None:
        self._good: Lru[AdCert] = Lru(maximum)

    def verified(self, wire: bytes, issuer_key: bytes) -> AdCert:
        """Return the AdCert if ``issuer_key`` (33 bytes) signed it. Time and rights are not checked.

        Raises:
            StatementError: MALFORMED, WRONG_NAME or BAD_SIGNATURE.
        """
        entry = hashlib.sha256(issuer_key + wire).digest()
        known = self._good.get(entry)
        if known is None:
            statement = parse(wire)
            known = AdCert.from_statement(statement)
            statement.verify(PublicKey.from_compressed(issuer_key))
            self._good.put(entry, known)
        return known


@dataclass(frozen=True, slots=True)
class Chain:
    """AdCerts from an owner to a node, each verified; empty where the node owns the name or the name has no owner."""

    links: tuple[AdCert, ...]

    @classmethod
    def traverse(
        cls,
        wires: Sequence[bytes],
        subject: Subject,
        node: Subject,
        cache: AdCertCache,
    ) -> Chain:
        """Verify a chain from the owner of ``subject`` to ``node``.

        Raises:
            StatementError: NOT_DELEGATED, BAD_SIGNATURE, WRONG_NAME or MALFORMED.
        """
        if len(wires) > CHAIN_MAX:
            raise StatementError(DropReason.NOT_DELEGATED, f"a chain of more than {CHAIN_MAX} links")
        issuer, issuer_key, may_delegate = subject.name, subject.owner_key, True
        links: list[AdCert] = []
        for wire in wires:
            if not may_delegate:
                raise StatementError(DropReason.NOT_DELEGATED, "a link that its issuer may not give")
            link = cache.verified(wire, issuer_key)
            if link.subject.name != subject.name:
                raise StatementError(DropReason.NOT_DELEGATED, "a link about another name")
            if link.issuer != issuer:
                raise StatementError(DropReason.NOT_DELEGATED, "a link that does not join the one before")
            issuer, issuer_key, may_delegate = link.delegate, link.delegate_key, link.may_delegate
            links.append(link)
        if links and (issuer, issuer_key) != (node.name, node.owner_key):
            raise StatementError(DropReason.NOT_DELEGATED, "the chain ends at another node")
        return cls(tuple(links))

    def check(self, right: Right, unix_s: float, revoked: Revocations | None = None) -> None:
        """Return if every link gives ``right`` at ``unix_s`` and none was revoked.

        Args:
            revoked: revocations by a link's issuer or by the owner; none if not given.

        Raises:
            StatementError: NOT_DELEGATED, EXPIRED or REVOKED.
        """
        issuer_key = self.links[0].subject.owner_key if self.links else b""
        for link in self.links:
            if right not in link.rights:
                raise StatementError(DropReason.NOT_DELEGATED, f"no right to {right.value}")
            link.validity.check(unix_s, "AdCert")
            takers = {link.subject.owner_key, issuer_key}
            if revoked is not None and any(revoked.has(link.fingerprint, key) for key in takers):
                raise StatementError(DropReason.REVOKED, "AdCert")
            issuer_key = link.delegate_key
