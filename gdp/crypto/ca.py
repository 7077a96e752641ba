"""Certificate authority of a domain: it creates the root and issues memberships on request.

Sans-I/O except for the randomness of serial numbers and of a token. Source: RFC 5280 (certificates), RFC 2986
(requests). ``openssl x509`` and ``openssl verify`` read what this module writes. ``certificates`` reads what ``openssl
x509 -req -copy_extensions copy`` issues from such a request. The library signs with its own keys only. For another key,
such as one in a token, a temporary key signs first; the part to be signed is taken from its result and gets the real
key's signature (RFC 6979 for those of this process).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from gdp.crypto.certificates import Membership, Role, Root
from gdp.crypto.keys import PublicKey, SigningKey, SoftwareKey
from gdp.crypto.pbes2 import der_element
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import (
    DOMAIN_UNIT,
    SubjectInfo,
    alternative_names,
    distinguished_name,
    read_request,
)
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata

_SEQUENCE: Final = 0x30
_BITS: Final = 0x03
_ECDSA_SHA256: Final = bytes.fromhex("300a06082a8648ce3d040302")  # RFC 5758, section 3.2
_KEY_ID_BYTES: Final = 20


@dataclass(frozen=True, slots=True)
class CertificateAuthority:
    """A trust domain's root with its private key: the holder of it decides which nodes belong.

    Attributes:
        next_serial: gives the serial number of each certificate; a simulation has its own, so that a run repeats.
    """

    key: SigningKey
    root: Root
    next_serial: Callable[[], int] = field(default=x509.random_serial_number, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.key.public != self.root.key:
            raise LocalError("this private key is not that of the domain's root")

    @classmethod
    def create(
        cls,
        label: str,
        key: SigningKey,
        validity: Validity,
        next_serial: Callable[[], int] = x509.random_serial_number,
    ) -> CertificateAuthority:
        """Return a new domain; kind, label and key give its id, which is a name.

        Raises:
            LocalError: the label is empty, too long or not printable.
        """
        subject = Subject.of(Metadata({"kind": DOMAIN_UNIT, "name": label}), key.public.compressed)
        distinguished = distinguished_name(DOMAIN_UNIT, label)
        builder = (
            _builder(next_serial(), distinguished, distinguished, subject, key.public, validity)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(is_authority=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier(subject.name[:_KEY_ID_BYTES]), critical=False)
        )
        return cls(key, Root.from_wire(signed_certificate(builder, key)), next_serial)

    def succeed(self, key: SigningKey, validity: Validity, retires_unix_s: int) -> CertificateAuthority:
        """Return the domain under another root key, which this one vouches for; the domain keeps its name.

        Args:
            retires_unix_s: until when signatures of this key are valid for nodes that have the successor's root.

        Raises:
            LocalError: it is the same key.
        """
        if key.public == self.root.key:
            raise LocalError("a successor has another key")
        name = x509.load_der_x509_certificate(self.root.wire).subject
        builder = (
            _builder(self.next_serial(), name, name, self.root.subject, key.public, validity, retires_unix_s)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(is_authority=True), critical=True)
            .add_extension(x509.SubjectKeyIdentifier(_key_id(key.public)), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier(self.root.key_id, None, None), critical=False)
        )
        return CertificateAuthority(
            key, self.root.succeeded_by(signed_certificate(builder, self.key)), self.next_serial
        )

    def renew(self, member: Membership, validity: Validity) -> Membership:
        """Issue a membership again, with the same key, role and label.

        Raises:
            LocalError: it is of another domain, it would outlive the root, or the root has expired.
        """
        if member.domain != self.root.domain:
            raise LocalError("a membership of another domain")
        return self._issue(SubjectInfo(member.subject, member.role.value, member.label, member.key), validity)

    def issue(self, request: bytes, validity: Validity) -> Membership:
        """Issue the membership that a request describes.

        The caller has decided that this node belongs, in the role and under the label of the request.

        Args:
            request: PKCS #10, DER or PEM.
            validity: as long as the node may stay; at most as long as the root's.

        Raises:
            StatementError: BAD_CERTIFICATE or WRONG_NAME, the request is not valid.
            LocalError: it would outlive the root, or the root has expired.
        """
        holder = read_request(request)
        if holder.unit not in [role.value for role in Role]:
            raise StatementError(DropReason.BAD_CERTIFICATE, f"{holder.unit!r} is no role of a node")
        return self._issue(holder, validity)

    def _issue(self, holder: SubjectInfo, validity: Validity) -> Membership:
        return Membership.from_wire(self.sign(holder, validity), self.root, validity.not_before_unix_s)

    def sign(self, holder: SubjectInfo, validity: Validity) -> bytes:
        """Return a certificate, DER, that is no authority; the caller has decided about its holder.

        Raises:
            LocalError: it would outlive the root.
        """
        if validity.not_after_unix_s > self.root.validity.not_after_unix_s:
            raise LocalError("a certificate cannot outlive the root of its domain")
        issuer = x509.load_der_x509_certificate(self.root.wire).subject
        subject = distinguished_name(holder.unit, holder.label)
        key_id = x509.AuthorityKeyIdentifier(self.root.key_id or None, None, None)
        builder = (
            _builder(self.next_serial(), issuer, subject, holder.subject, holder.key, validity)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(is_authority=False), critical=True)
            .add_extension(x509.SubjectKeyIdentifier(holder.subject.name[:_KEY_ID_BYTES]), critical=False)
            .add_extension(key_id, critical=False)
        )
        return signed_certificate(builder, self.key)


def request_membership(key: SigningKey, role: Role, label: str, digest: bytes) -> bytes:
    """Return a PKCS #10 request, PEM, by which a node requests its membership in a domain.

    Raises:
        LocalError: the label is empty, too long or not printable.
    """
    builder = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(distinguished_name(role.value, label))
        .add_extension(alternative_names(Subject(digest, key.public.compressed)), critical=False)
    )
    return signed_request(builder, key)


def _builder(
    serial: int,
    issuer: x509.Name,
    holder: x509.Name,
    subject: Subject,
    key: PublicKey,
    validity: Validity,
    retires_unix_s: int | None = None,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .serial_number(serial)
        .issuer_name(issuer)
        .subject_name(holder)
        .public_key(key.point)
        .not_valid_before(_moment(validity.not_before_unix_s))
        .not_valid_after(_moment(validity.not_after_unix_s))
        .add_extension(alternative_names(subject, retires_unix_s), critical=False)
    )


def _key_id(key: PublicKey) -> bytes:
    """Return a successor's key id: it differs from the founder's, which is the domain's name."""
    return hashlib.sha256(key.compressed).digest()[:_KEY_ID_BYTES]


def _moment(unix_s: int) -> datetime:
    try:
        return datetime.fromtimestamp(unix_s, timezone.utc)
    except (ValueError, OverflowError, OSError) as error:
        raise LocalError(f"no calendar reaches second {unix_s}") from error


def _key_usage(*, is_authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        encipher_only=False,
        decipher_only=False,
    )


def signed_certificate(builder: x509.CertificateBuilder, key: SigningKey) -> bytes:
    """Return a certificate, DER."""
    if isinstance(key, SoftwareKey):
        return builder.sign(key.private, hashes.SHA256(), ecdsa_deterministic=True).public_bytes(Encoding.DER)
    draft = builder.sign(SigningKey.generate().private, hashes.SHA256())
    return _completed(draft.tbs_certificate_bytes, key)


def signed_request(builder: x509.CertificateSigningRequestBuilder, key: SigningKey) -> bytes:
    """Return a certificate request, PEM."""
    if isinstance(key, SoftwareKey):
        return builder.sign(key.private, hashes.SHA256(), ecdsa_deterministic=True).public_bytes(Encoding.PEM)
    drawn = SigningKey.generate()
    draft = builder.sign(drawn.private, hashes.SHA256()).tbs_certrequest_bytes
    # Both are P-256 keys, so that the temporary one has the same length.
    wire = _completed(draft.replace(_info(drawn.public), _info(key.public)), key)
    return x509.load_der_x509_csr(wire).public_bytes(Encoding.PEM)


def _completed(signed_part: bytes, key: SigningKey) -> bytes:
    signature = der_element(_BITS, b"\0" + key.sign_der(signed_part))
    return der_element(_SEQUENCE, signed_part + _ECDSA_SHA256 + signature)


def _info(key: PublicKey) -> bytes:
    return key.point.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
