"""Owner of names: its key defines the names, and it delegates them to nodes.

Sans-I/O except for the randomness of signatures and seals. The owner's key and master secret never leave its machine:
nodes get delegations.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.limits import CHAIN_MAX
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.trust.adcert import AdCert
from gdp.trust.delegation import Delegation
from gdp.trust.grants import SECRET_BYTES, make_grant
from gdp.trust.node_descriptor import Recipient
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right

_SUCCESSOR: Final = b"gdp-owner-successor-1"


@dataclass(frozen=True, slots=True)
class Owner:
    """An owner's key, and the one secret from which the secrets of all its topics are derived.

    A name contains its owner's key, so the key of a name never changes. Which node or key acts with it may change. The
    owner may let a successor's key delegate its names, with one link of a chain for each name.

    Args:
        key: owns names, or is the successor for the founder's names.
        master: 32 random bytes.
        founder: the key that the names contain, where it is not ``key``.
        successions: of a successor: by name, the links from the founder to ``key``.

    Raises:
        LocalError: the master secret has another length.
    """

    key: SigningKey
    master: bytes = field(repr=False)
    founder: PublicKey | None = None
    successions: Mapping[Name, tuple[bytes, ...]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if len(self.master) != SECRET_BYTES:
            raise LocalError(f"an owner's master secret has {SECRET_BYTES} bytes")

    @property
    def public(self) -> PublicKey:
        """Return the key that the names contain."""
        return self.key.public if self.founder is None else self.founder

    @property
    def signer(self) -> Subject:
        """Return the subject under which a successor signs."""
        return successor_subject(self.key.public)

    def subject(self, metadata: Metadata) -> Subject:
        """Return the name that this metadata has under this owner, and what proves it."""
        return Subject.of(metadata, self.public.compressed)

    def succeed(self, successor: PublicKey, subject: Subject, validity: Validity) -> Delegation:
        """Return the delegation by which a successor's key may delegate one name in place of this key.

        Args:
            validity: how long it may; all its delegations end with it.

        Raises:
            LocalError: another owner's name, or one for which this key is no successor.
        """
        chain, issuer = self._links(subject)
        to, rights = successor_subject(successor), frozenset(Right) - {Right.ATTACH}
        link = AdCert.make(self.key, issuer, subject, to, rights, validity, may_delegate=True)
        return Delegation(
            subject=subject, node=to.name, rights=rights, chain=(*chain, link), grants=MappingProxyType({})
        )

    def _links(self, subject: Subject) -> tuple[tuple[bytes, ...], Name]:
        """Return the links from a name's key to this one, and the issuer of the next link."""
        if subject.owner_key != self.public.compressed:
            raise LocalError("another owner's name")
        if self.founder is None:
            return (), subject.name
        links = self.successions.get(subject.name)
        if links is None:
            raise LocalError(
                f"this key did not succeed to {subject.name.to_text()}: gdp cert succeed with the key that did"
            )
        return links, self.signer.name

    def delegate(
        self,
        recipient: Recipient,
        metadata: Metadata,
        rights: Collection[Right],
        epochs: Iterable[int],
        validity: Validity,
        *,
        may_delegate: bool = False,
    ) -> Delegation:
        """Return the delegation by which a node may act on a name.

        Args:
            recipient: the node: its verified node descriptor, or an equivalent proof.
            metadata: of the name; the file holds it in plain, for the node's operator.
            rights: of publish, serve, call and read.
            epochs: the epochs whose secrets the node gets.
            validity: how long it may act; the secrets, once known, stay known.
            may_delegate: whether the node may delegate the rights further.

        Raises:
            LocalError: rights or epochs out of bounds, or a library without the KEM.
            StatementError: MALFORMED, the recipient's key is invalid.
        """
        subject = self.subject(metadata)
        chain, issuer = self._links(subject)
        if len(chain) >= CHAIN_MAX:
            raise LocalError(f"a chain of more than {CHAIN_MAX} links")
        to = recipient.subject
        link = AdCert.make(self.key, issuer, subject, to, rights, validity, may_delegate=may_delegate)
        grants = {
            epoch: make_grant(self.key, self.master, subject, epoch, to.name, recipient.kem)
            for epoch in sorted(set(epochs))
        }
        return Delegation(
            subject=subject,
            node=to.name,
            rights=frozenset(rights),
            chain=(*chain, link),
            grants=MappingProxyType(grants),
            metadata=metadata,
        )

    def regrant(self, given: Delegation, recipient: Recipient, epochs: Iterable[int]) -> Delegation:
        """Return a delegation with the secrets of other epochs, and with the same chain: no right changes.

        Raises:
            LocalError, StatementError: as ``delegate``.
        """
        grants = {
            epoch: given.grants.get(epoch)
            or make_grant(self.key, self.master, given.subject, epoch, given.node, recipient.kem)
            for epoch in sorted(set(epochs))
        }
        return replace(given, grants=MappingProxyType(grants))

    def revoke(self, subject: Subject, fingerprint: bytes, until_unix_s: int) -> bytes:
        """Return the revocation of an AdCert on one of this owner's names; a successor may revoke what it issued.

        Raises:
            LocalError: another owner's name.
        """
        if subject.owner_key != self.public.compressed:
            raise LocalError("only a name's owner takes back what it gave")
        return Revocation.make(self.key, subject if self.founder is None else self.signer, fingerprint, until_unix_s)


def successor_subject(key: PublicKey) -> Subject:
    """Return the name under which a successor's key stands in a chain."""
    return Subject(hashlib.sha256(_SUCCESSOR).digest(), key.compressed)
