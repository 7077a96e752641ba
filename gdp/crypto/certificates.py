"""X.509 for trust domains: a root that vouches for itself, and the membership of a node that the root signs.

Place: pure. The form of both stands in ``x509_form``, making them in ``issuing``.
Source: RFC 5280.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from enum import Enum

from gdp.crypto.keys import PublicKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.crypto.x509_form import DOMAIN_UNIT, Certificate, bad, issuer_common_name, read
from gdp.errors import DropReason, StatementError
from gdp.names import Name

__all__ = ["Membership", "Role", "Root", "Unverified", "issuer_label"]


class Role(str, Enum):
    """What a node is in its domain."""

    SWITCH = "switch"
    RIB = "rib"
    PROXY = "proxy"


@dataclass(frozen=True, slots=True)
class Root:
    """A trust domain's own certificate; its signature, its name and its form have been checked.

    Trusting it is the policy's decision, made by putting it there.
    """

    subject: Subject
    label: str
    key: PublicKey
    validity: Validity
    key_id: bytes
    distinguished_name: bytes = field(repr=False)  # DER
    wire: bytes = field(repr=False)  # DER

    @property
    def domain(self) -> Name:
        """Return the domain's id, which is a name like all others."""
        return self.subject.name

    @classmethod
    def from_wire(cls, wire: bytes) -> Root:
        """Read a root in DER or PEM.

        Raises:
            StatementError: BAD_CERTIFICATE or WRONG_NAME.
        """
        certificate = read(wire)
        if (
            certificate.holder.unit != DOMAIN_UNIT
            or not certificate.is_authority
            or certificate.issuer != certificate.distinguished_name
        ):
            raise bad("not the root of a trust domain")
        _check_signature(certificate, certificate.holder.key)
        return cls(
            subject=certificate.holder.subject,
            label=certificate.holder.label,
            key=certificate.holder.key,
            validity=certificate.validity,
            key_id=certificate.key_id,
            distinguished_name=certificate.distinguished_name,
            wire=certificate.wire,
        )


@dataclass(frozen=True, slots=True)
class Membership:
    """A node's certificate that a root did sign. Time and revocation move on, so they are asked at each use."""

    subject: Subject
    role: Role
    domain: Name
    label: str
    key: PublicKey
    validity: Validity
    fingerprint: bytes  # SHA-256 of the signed part: no second signature makes it another
    wire: bytes = field(repr=False)  # DER

    @property
    def name(self) -> Name:
        """Return the node's name."""
        return self.subject.name

    @property
    def digest(self) -> bytes:
        """Return the digest of the node's metadata."""
        return self.subject.digest

    @property
    def not_before_unix_s(self) -> int:
        """Return the first second of its validity."""
        return self.validity.not_before_unix_s

    @property
    def not_after_unix_s(self) -> int:
        """Return the last second of its validity."""
        return self.validity.not_after_unix_s

    @classmethod
    def from_wire(cls, wire: bytes, root: Root, unix_s: float) -> Membership:
        """Read and verify a membership in DER or PEM.

        Raises:
            StatementError: BAD_CERTIFICATE, WRONG_NAME, WRONG_DOMAIN or EXPIRED.
        """
        return Unverified.from_wire(wire).verify(root, unix_s)


def issuer_label(wire: bytes) -> str:
    """Return the label of the domain that a certificate, DER, says it is of: unproven, printable, maybe empty."""
    try:
        label = issuer_common_name(wire)
    except StatementError:
        return ""
    return label if label.isprintable() else ""


@dataclass(frozen=True, slots=True)
class Unverified:
    """A membership whose name comes out, but whose issuer has not been asked for yet."""

    subject: Subject
    role: Role
    label: str
    key: PublicKey
    validity: Validity
    issuer_key_id: bytes
    wire: bytes = field(repr=False)  # DER
    certificate: Certificate = field(repr=False)

    @classmethod
    def from_wire(cls, wire: bytes) -> Unverified:
        """Read a membership in DER or PEM; costs about 0.1 ms.

        Raises:
            StatementError: BAD_CERTIFICATE or WRONG_NAME; never another exception, whatever the bytes.
        """
        certificate = read(wire)
        try:
            role = Role(certificate.holder.unit)
        except ValueError as error:
            raise bad("an unknown role") from error
        if certificate.is_authority:
            raise bad("a membership that would be an authority")
        return cls(
            subject=certificate.holder.subject,
            role=role,
            label=certificate.holder.label,
            key=certificate.holder.key,
            validity=certificate.validity,
            issuer_key_id=certificate.issuer_key_id,
            wire=certificate.wire,
            certificate=certificate,
        )

    def verify(self, root: Root, unix_s: float) -> Membership:
        """Return the membership if ``root`` issued it and both are valid at ``unix_s``.

        Raises:
            StatementError: WRONG_DOMAIN (another issuer), BAD_CERTIFICATE (the signature) or EXPIRED.
        """
        if self.certificate.issuer != root.distinguished_name or self.issuer_key_id not in (b"", root.key_id):
            raise StatementError(DropReason.WRONG_DOMAIN, "not issued by this domain")
        root.validity.check(unix_s, "domain root")
        self.validity.check(unix_s, "membership")
        _check_signature(self.certificate, root.key)
        return Membership(
            subject=self.subject,
            role=self.role,
            domain=root.domain,
            label=self.label,
            key=self.key,
            validity=self.validity,
            fingerprint=hashlib.sha256(self.certificate.signed_bytes).digest(),
            wire=self.wire,
        )


def _check_signature(certificate: Certificate, key: PublicKey) -> None:
    try:
        key.verify_der(certificate.signature, certificate.signed_bytes)
    except StatementError as error:
        raise bad("the signature does not hold") from error
