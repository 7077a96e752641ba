"""An owner: who may say what a name is for, and whom it serves.

Place: pure, but for the randomness of signatures and seals. The owner's key and master secret never leave its machine:
nodes get delegations.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from types import MappingProxyType

from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.trust.adcert import AdCert
from gdp.trust.card import Card
from gdp.trust.delegation import Delegation
from gdp.trust.grants import SECRET_BYTES, make_grant
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right

__all__ = ["Owner"]


@dataclass(frozen=True, slots=True)
class Owner:
    """An owner's key, and the one secret from which those of all its topics come.

    Args:
        key: owns names.
        master: 32 random bytes.

    Raises:
        LocalError: the master secret has another length.
    """

    key: SigningKey
    master: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.master) != SECRET_BYTES:
            raise LocalError(f"an owner's master secret has {SECRET_BYTES} bytes")

    def subject(self, metadata: Metadata) -> Subject:
        """Return the name that this metadata has under this owner, and what proves it."""
        return Subject.of(metadata, self.key.public.compressed)

    def delegate(
        self,
        card: Card,
        metadata: Metadata,
        rights: Collection[Right],
        epochs: Iterable[int],
        validity: Validity,
        *,
        may_delegate: bool = False,
    ) -> Delegation:
        """Return what lets a node act on a name.

        Args:
            card: of the node.
            metadata: of the name; goes into the file in plain, for the node's operator.
            rights: of publish, serve, call and read.
            epochs: whose secrets the node gets.
            validity: how long it may act; the secrets, once known, stay known.
            may_delegate: whether the node may pass the rights on.

        Raises:
            LocalError: rights or epochs out of bounds, or a library without the KEM.
            StatementError: MALFORMED, the card's key is none.
        """
        subject = self.subject(metadata)
        link = AdCert.make(self.key, subject.name, subject, card.subject, rights, validity, may_delegate=may_delegate)
        grants = {
            epoch: make_grant(self.key, self.master, subject, epoch, card.name, card.kem)
            for epoch in sorted(set(epochs))
        }
        return Delegation(subject, card.name, frozenset(rights), (link,), MappingProxyType(grants), metadata)

    def revoke(self, subject: Subject, fingerprint: bytes, until_unix_s: int) -> bytes:
        """Return the statement that takes back an AdCert on one of this owner's names.

        Raises:
            LocalError: another owner's name.
        """
        if subject.owner_key != self.key.public.compressed:
            raise LocalError("only a name's owner takes back what it gave")
        return Revocation.make(self.key, subject, fingerprint, until_unix_s)
