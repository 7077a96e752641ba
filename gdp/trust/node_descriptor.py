"""Node descriptor: the public identity document that an owner needs to delegate to a node; it holds no secret.

Sans-I/O. The descriptor binds the key that receives secrets to the node's name. The person who supplies it vouches that
this is the node that the owner means; the name in it cannot be another's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Protocol

from gdp.crypto.certificates import Membership, Root, Unverified
from gdp.crypto.identity import Identity
from gdp.crypto.kem import KEM_PUBLIC, KemPublicKey
from gdp.crypto.schema import CERT, Body, Keyed
from gdp.crypto.statements import StatementType, parse
from gdp.crypto.subject import Subject
from gdp.names import Name


class Recipient(Protocol):
    """Recipient of a delegation: a node's name, and the key that secrets for it are sealed to."""

    @property
    def subject(self) -> Subject:
        """Return the node's name and what proves it."""

    @property
    def kem(self) -> KemPublicKey:
        """Return the public key that secrets for the node are sealed to."""


@dataclass(frozen=True, slots=True)
class _Card(Body):
    TYPE = StatementType.CARD
    member: Annotated[bytes, Keyed("member", CERT)]
    kem: Annotated[KemPublicKey, Keyed("kem", KEM_PUBLIC)]


@dataclass(frozen=True, slots=True)
class NodeDescriptor:
    """A verified node descriptor.

    Args:
        subject: the node's name and what proves it.
        kem: the key that secrets for it are sealed to.
        stranger: its certificate, whose issuer has not been verified.
    """

    subject: Subject
    kem: KemPublicKey
    stranger: Unverified
    wire: bytes = field(repr=False)

    @property
    def name(self) -> Name:
        """Return the node's name."""
        return self.subject.name

    @property
    def label(self) -> str:
        """Return the node's name for people, as in its certificate."""
        return self.stranger.label

    @staticmethod
    def make(identity: Identity) -> bytes:
        """Return the node's signed statement."""
        return _Card(identity.membership, identity.kem.public).to_wire(identity.name, identity.key)

    @classmethod
    def from_wire(cls, wire: bytes) -> NodeDescriptor:
        """Read a node descriptor and verify that the node itself signed it.

        Raises:
            StatementError: MALFORMED, BAD_CERTIFICATE, WRONG_NAME or BAD_SIGNATURE.
        """
        statement = parse(wire)
        card = _Card.from_statement(statement)
        stranger = Unverified.of_signer(card.member, statement)
        return cls(stranger.subject, card.kem, stranger, wire)

    def member_of(self, root: Root, unix_s: float) -> Membership:
        """Return the membership if ``root`` issued it and it is valid now.

        Raises:
            StatementError: WRONG_DOMAIN, BAD_CERTIFICATE or EXPIRED.
        """
        return self.stranger.verify(root, unix_s)
