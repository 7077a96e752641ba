"""X.509 profile of every certificate in the project, and the only module that parses X.509.

Sans-I/O. Source: RFC 5280; ECDSA P-256 with SHA-256 throughout. Readers raise ``StatementError`` (BAD_CERTIFICATE or
WRONG_NAME) and never another exception, for any bytes. Project data use standard fields::

    subject   OU = role (switch | rib | proxy; "domain" in a root), CN = the label for people
    SAN       URI gdp:<64 hex, the name>   URI gdp-metadata:<64 hex, digest of the metadata>
              in a successor's root also   URI gdp-founder:<66 hex, the key that the name is made of>
                                           URI gdp-retires:<unix second at which the predecessor is trusted no more>
    key ids   the first 20 bytes of the domain's name; another tool may use another method (RFC 7093)

A name is the hash of digest and key. So a certificate whose three do not fit is rejected before any signature check. A
domain keeps its name when another root key succeeds the first: its root then contains the founder's key.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final, TypeVar

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtensionOID, NameOID, ObjectIdentifier, SignatureAlgorithmOID

from gdp.crypto.keys import PublicKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name

CERTIFICATE_MAX_BYTES: Final = 4_096
LABEL_MAX_CHARS: Final = 64  # ub-common-name; RFC 5280, appendix A.1
NAME_URI: Final = "gdp:"
METADATA_URI: Final = "gdp-metadata:"
FOUNDER_URI: Final = "gdp-founder:"
RETIRES_URI: Final = "gdp-retires:"
DOMAIN_UNIT: Final = "domain"

_T = TypeVar("_T")
_UNIX_SECOND: Final = re.compile(r"[0-9]{1,12}", re.ASCII)
_HOST: Final = re.compile(r"(?=.{1,253}\Z)[a-z0-9]([a-z0-9-]*[a-z0-9])?(\.[a-z0-9]([a-z0-9-]*[a-z0-9])?)*", re.I | re.A)
_PEM: Final = b"-----"

_UNDERSTOOD: Final = frozenset(
    {ExtensionOID.BASIC_CONSTRAINTS, ExtensionOID.KEY_USAGE, ExtensionOID.SUBJECT_ALTERNATIVE_NAME}
)
_FOREIGN_ERRORS: Final = (
    ValueError,
    TypeError,
    LookupError,  # some versions have it for string types that they do not know
    UnsupportedAlgorithm,
    x509.InvalidVersion,
    x509.DuplicateExtension,
    x509.ExtensionNotFound,
    x509.UnsupportedGeneralNameType,
    Warning,  # a library warning is an error here
)


@dataclass(frozen=True, slots=True)
class SubjectInfo:
    """Subject of a certificate or a request; the name's hash is right."""

    subject: Subject
    unit: str  # role, or "domain"
    label: str
    key: PublicKey
    retires_unix_s: int | None = None  # of a root that succeeds another: until when that one is trusted


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """A certificate of this profile; its signature, time and issuer are not checked."""

    holder: SubjectInfo
    validity: Validity
    is_authority: bool
    issuer: bytes  # distinguished name, DER
    distinguished_name: bytes  # DER
    key_id: bytes  # empty where not given
    issuer_key_id: bytes  # empty where not given
    signature: bytes  # DER
    signed_bytes: bytes
    wire: bytes  # DER


def bad(detail: str) -> StatementError:
    """Return the error for a certificate."""
    return StatementError(DropReason.BAD_CERTIFICATE, detail)


def read(wire: bytes) -> Certificate:
    """Read a certificate in DER or PEM; costs about 0.1 ms."""
    return _strictly(wire, _certificate)


def read_request(wire: bytes) -> SubjectInfo:
    """Read a certificate request (PKCS #10) in DER or PEM; its own signature proves possession of the key."""
    return _strictly(wire, _request)


def issuer_common_name(wire: bytes) -> str:
    """Return the issuer's CN of a certificate in DER, at most ``LABEL_MAX_CHARS`` of it; nothing is verified.

    Raises:
        StatementError: BAD_CERTIFICATE; never another exception, for any bytes.
    """
    return _strictly(wire, _issuer_common_name)


def _issuer_common_name(wire: bytes) -> str:
    names = x509.load_der_x509_certificate(wire).issuer.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value)[:LABEL_MAX_CHARS] if names else ""


def to_pem(wire: bytes) -> bytes:
    """Return a certificate that was read here, DER, as PEM."""
    return x509.load_der_x509_certificate(wire).public_bytes(Encoding.PEM)


def distinguished_name(unit: str, label: str) -> x509.Name:
    """Return OU and CN. Raises ``LocalError``: the label is empty, too long or holds control characters."""
    if not 0 < len(label) <= LABEL_MAX_CHARS or not label.isprintable():
        raise LocalError(f"a label has 1 to {LABEL_MAX_CHARS} printable characters")
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, unit),
            x509.NameAttribute(NameOID.COMMON_NAME, label),
        ]
    )


def alternative_names(
    subject: Subject, retires_unix_s: int | None = None, hosts: Iterable[str] = ()
) -> x509.SubjectAlternativeName:
    """Return the URIs that carry a name and its parts.

    Args:
        retires_unix_s: of a root that succeeds another: until when that one is trusted.
        hosts: names and addresses of a server, by which its clients know it.
    """
    texts = [NAME_URI + subject.name.to_text(), METADATA_URI + subject.digest.hex()]
    if retires_unix_s is not None:
        texts += [FOUNDER_URI + subject.owner_key.hex(), f"{RETIRES_URI}{retires_unix_s}"]
    uris = [x509.UniformResourceIdentifier(text) for text in texts]
    return x509.SubjectAlternativeName([*uris, *map(_host, hosts)])


def _host(text: str) -> x509.GeneralName:
    """Return an address, or a name of DNS (RFC 5280, section 4.2.1.6). Raises ``LocalError``: it is neither."""
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        if not _HOST.fullmatch(text):
            raise LocalError(f"expected the name or the address of a host, not {text!r}") from None
        return x509.DNSName(text)


def _strictly(wire: bytes, reader: Callable[[bytes], _T]) -> _T:
    """Translate any exception of the library about received bytes into the one error."""
    if len(wire) > CERTIFICATE_MAX_BYTES:
        raise bad(f"longer than {CERTIFICATE_MAX_BYTES} bytes")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return reader(wire)
        except _FOREIGN_ERRORS as error:
            raise bad(f"not of the form used here ({type(error).__name__})") from error
        except StatementError as error:
            if error.reason is DropReason.MALFORMED:
                raise bad(error.detail) from error
            raise


def _request(wire: bytes) -> SubjectInfo:
    request = x509.load_pem_x509_csr(wire) if wire.startswith(_PEM) else x509.load_der_x509_csr(wire)
    if not request.is_signature_valid:
        raise bad("the request's signature does not hold")
    return _holder(request.subject, request.extensions, PublicKey.from_point(request.public_key()))


def _certificate(wire: bytes) -> Certificate:
    pem = wire.startswith(_PEM)
    certificate = x509.load_pem_x509_certificate(wire) if pem else x509.load_der_x509_certificate(wire)
    if certificate.signature_algorithm_oid != SignatureAlgorithmOID.ECDSA_WITH_SHA256:
        raise bad("not signed with ECDSA and SHA-256")
    extensions = certificate.extensions
    if any(extension.critical and extension.oid not in _UNDERSTOOD for extension in extensions):
        raise bad("a critical extension that is not understood")
    der, signature = certificate.public_bytes(Encoding.DER), certificate.signature
    if not der.endswith(bytes((0x03, len(signature) + 1, 0)) + signature):  # the library ignores unused bits
        raise bad("a signature that is not in DER")
    return Certificate(
        holder=_holder(certificate.subject, extensions, PublicKey.from_point(certificate.public_key())),
        validity=Validity(
            int(certificate.not_valid_before_utc.timestamp()), int(certificate.not_valid_after_utc.timestamp())
        ),
        is_authority=_is_authority(extensions),
        issuer=certificate.issuer.public_bytes(),
        distinguished_name=certificate.subject.public_bytes(),
        key_id=_key_id(extensions),
        issuer_key_id=_issuer_key_id(extensions),
        signature=signature,
        signed_bytes=certificate.tbs_certificate_bytes,
        wire=der,
    )


def _holder(distinguished: x509.Name, extensions: x509.Extensions, key: PublicKey) -> SubjectInfo:
    label = _only(distinguished, NameOID.COMMON_NAME)
    if not 0 < len(label) <= LABEL_MAX_CHARS or not label.isprintable():
        raise bad("a label that is empty, too long or not printable")
    uris = extensions.get_extension_for_class(x509.SubjectAlternativeName).value.get_values_for_type(
        x509.UniformResourceIdentifier
    )
    unit = _only(distinguished, NameOID.ORGANIZATIONAL_UNIT_NAME)
    founder, retires_unix_s = _succession(uris) if unit == DOMAIN_UNIT else (None, None)
    return SubjectInfo(
        subject=Subject.proving(Name(_uri(uris, NAME_URI)), _uri(uris, METADATA_URI), founder or key.compressed),
        unit=unit,
        label=label,
        key=key,
        retires_unix_s=retires_unix_s,
    )


def _succession(uris: list[str]) -> tuple[bytes | None, int | None]:
    """Return the founder's key and the predecessor's last second from a root with a predecessor."""
    founders = [uri.removeprefix(FOUNDER_URI) for uri in uris if uri.startswith(FOUNDER_URI)]
    moments = [uri.removeprefix(RETIRES_URI) for uri in uris if uri.startswith(RETIRES_URI)]
    if not founders and not moments:
        return None, None
    if len(founders) != 1 or len(moments) != 1 or not _UNIX_SECOND.fullmatch(moments[0]):
        raise bad(f"a successor's root has one {FOUNDER_URI} and one {RETIRES_URI}")
    return PublicKey.from_compressed(bytes.fromhex(founders[0])).compressed, int(moments[0])


def _only(name: x509.Name, oid: ObjectIdentifier) -> str:
    values = name.get_attributes_for_oid(oid)
    if len(values) != 1 or not isinstance(values[0].value, str):
        raise bad("a subject without exactly one OU and one CN")
    return values[0].value


def _uri(uris: list[str], scheme: str) -> bytes:
    values = [uri.removeprefix(scheme) for uri in uris if uri.startswith(scheme)]
    if len(values) != 1:
        raise bad(f"{len(values)} alternative names {scheme}, not one")
    try:
        return bytes(Name.from_text(values[0]))
    except LocalError as error:
        raise bad(f"{scheme} is not followed by 64 hex digits") from error


def _is_authority(extensions: x509.Extensions) -> bool:
    try:
        return extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except x509.ExtensionNotFound:
        return False


def _key_id(extensions: x509.Extensions) -> bytes:
    try:
        return extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value.digest
    except x509.ExtensionNotFound:
        return b""


def _issuer_key_id(extensions: x509.Extensions) -> bytes:
    try:
        return extensions.get_extension_for_class(x509.AuthorityKeyIdentifier).value.key_identifier or b""
    except x509.ExtensionNotFound:
        return b""
