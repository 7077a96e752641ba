"""X.509 certificates of trust domains: the self-signed root, and the membership of a node, which the root signs.

Sans-I/O. ``x509_profile`` defines the format of both; ``ca`` makes them. Source: RFC 5280.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

from gdp.crypto.keys import PublicKey
from gdp.crypto.statements import Statement
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import DOMAIN_UNIT, Certificate, bad, issuer_common_name, read, to_pem
from gdp.errors import DropReason, StatementError
from gdp.names import Name

_SUCCESSIONS_MAX: Final = 8
_PEM_BEGIN: Final = b"-----BEGIN"
_PEM_END: Final = b"-----END CERTIFICATE-----\n"


class Role(str, Enum):
    """Role of a node in its domain.

    A leaf is a switch that carries the traffic of the nodes attached to it and no transit (RFC 6987, stub router).
    Other switches enforce that by its certificate.
    """

    SWITCH = "switch"
    RIB = "rib"
    PROXY = "proxy"
    LEAF = "leaf"

    @property
    def is_switch(self) -> bool:
        """Return whether nodes attach to it and it originates link states: a switch or a leaf."""
        return self in (Role.SWITCH, Role.LEAF)


@dataclass(frozen=True, slots=True, kw_only=True)
class Root:
    """A trust domain's own certificate; its signature, its name and its format have been checked.

    A policy trusts it by including it.
    """

    subject: Subject
    label: str
    key: PublicKey
    validity: Validity
    key_id: bytes
    distinguished_name: bytes = field(repr=False)  # DER
    wire: bytes = field(repr=False)  # DER
    predecessors: tuple[Root, ...] = ()  # the oldest first; each ends at the time in its successor

    @property
    def domain(self) -> Name:
        """Return the domain's id, which is a name: the founder's, also under successors."""
        return self.subject.name

    @property
    def lineage(self) -> tuple[Root, ...]:
        """Return the domain's roots, the founding one first, this one last."""
        return (*self.predecessors, self)

    @property
    def signer(self) -> Subject:
        """Return the subject under which this root's key signs: the domain, or in its place the successor's key."""
        return Subject(self.subject.digest, self.key.compressed)

    @classmethod
    def from_wire(cls, wire: bytes) -> Root:
        """Read a root in DER or PEM; in PEM its successors may follow it, each signed by the one before.

        Raises:
            StatementError: BAD_CERTIFICATE or WRONG_NAME.
        """
        first, *successors = _blocks(wire)
        certificate = _root_form(first)
        if certificate.holder.retires_unix_s is not None:
            raise bad("the successor of a root, without the root that it succeeds")
        _check_signature(certificate, certificate.holder.key)
        root = cls._of(certificate)
        for each in successors:
            root = root.succeeded_by(each)
        return root

    def succeeded_by(self, wire: bytes) -> Root:
        """Return the successor that this root signed; this root ends at the time in the successor.

        Raises:
            StatementError: BAD_CERTIFICATE or WRONG_NAME: not by this root, or of another domain.
        """
        certificate = _root_form(wire)
        retires_unix_s = certificate.holder.retires_unix_s
        if retires_unix_s is None or certificate.holder.subject != self.subject:
            raise bad("not a successor of this domain's root")
        if len(self.predecessors) >= _SUCCESSIONS_MAX:
            raise bad(f"more than {_SUCCESSIONS_MAX} successions")
        if certificate.issuer != self.distinguished_name or certificate.issuer_key_id != self.key_id:
            raise bad("a successor that another root issued")
        _check_signature(certificate, self.key)
        end = min(self.validity.not_after_unix_s, retires_unix_s)
        retired = replace(self, validity=Validity(self.validity.not_before_unix_s, end), predecessors=())
        return replace(Root._of(certificate), predecessors=(*self.predecessors, retired))

    def to_pem(self) -> bytes:
        """Return what ``from_wire`` reads: this root, after its predecessors."""
        return b"".join(to_pem(each.wire) for each in self.lineage)

    @classmethod
    def _of(cls, certificate: Certificate) -> Root:
        return cls(
            subject=certificate.holder.subject,
            label=certificate.holder.label,
            key=certificate.holder.key,
            validity=certificate.validity,
            key_id=certificate.key_id,
            distinguished_name=certificate.distinguished_name,
            wire=certificate.wire,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Membership:
    """A node's certificate whose root signature was verified. Time and revocation are checked at each use."""

    subject: Subject
    role: Role
    domain: Name
    label: str
    key: PublicKey
    validity: Validity
    fingerprint: bytes  # SHA-256 of the signed part: a second signature does not change it
    issuer_key: bytes  # of the root that signed it, 33 bytes
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
    """Return the domain label in a certificate, DER: unproven, printable, maybe empty."""
    try:
        label = issuer_common_name(wire)
    except StatementError:
        return ""
    return label if label.isprintable() else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Unverified:
    """A membership whose name is right, but whose issuer has not been verified yet."""

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
            StatementError: BAD_CERTIFICATE or WRONG_NAME; never another exception, for any bytes.
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

    @classmethod
    def of_signer(cls, wire: bytes, statement: Statement) -> Unverified:
        """Return the membership in a statement if it is its signer's, and the signature holds.

        Raises:
            StatementError: BAD_CERTIFICATE, WRONG_NAME or BAD_SIGNATURE.
        """
        stranger = cls.from_wire(wire)
        if stranger.subject.name != statement.signer:
            raise bad(f"{statement.type.value} under another's certificate")
        statement.verify(stranger.key)
        return stranger

    def verify(self, root: Root, unix_s: float) -> Membership:
        """Return the membership if ``root`` issued it and both are valid at ``unix_s``.

        Raises:
            StatementError: WRONG_DOMAIN (another issuer), BAD_CERTIFICATE (the signature) or EXPIRED.
        """
        issuer = self._issuer(root)
        issuer.validity.check(unix_s, "domain root")
        self.validity.check(unix_s, "membership")
        return Membership(
            subject=self.subject,
            role=self.role,
            domain=root.domain,
            label=self.label,
            key=self.key,
            validity=self.validity,
            fingerprint=hashlib.sha256(self.certificate.signed_bytes).digest(),
            issuer_key=issuer.key.compressed,
            wire=self.wire,
        )

    def _issuer(self, root: Root) -> Root:
        """Return the root of a domain that signed this, the newest first."""
        refusal = StatementError(DropReason.WRONG_DOMAIN, "not issued by this domain")
        for each in reversed(root.lineage):
            if self.certificate.issuer != each.distinguished_name or self.issuer_key_id not in (b"", each.key_id):
                continue
            try:
                _check_signature(self.certificate, each.key)
            except StatementError as error:
                refusal = error
            else:
                return each
        raise refusal


def _blocks(wire: bytes) -> list[bytes]:
    """Return the certificates of a file: one in DER, or each of several in PEM."""
    if not wire.startswith(_PEM_BEGIN):
        return [wire]
    blocks = [part + _PEM_END for part in wire.split(_PEM_END) if part.strip()]
    if len(blocks) > 1 + _SUCCESSIONS_MAX:
        raise bad(f"more than {_SUCCESSIONS_MAX} successions")
    return [block.lstrip() for block in blocks]


def _root_form(wire: bytes) -> Certificate:
    certificate = read(wire)
    is_own = certificate.issuer == certificate.distinguished_name
    if certificate.holder.unit != DOMAIN_UNIT or not certificate.is_authority or not is_own:
        raise bad("not the root of a trust domain")
    return certificate


def _check_signature(certificate: Certificate, key: PublicKey) -> None:
    try:
        key.verify_der(certificate.signature, certificate.signed_bytes)
    except StatementError as error:
        raise bad("the signature does not hold") from error
