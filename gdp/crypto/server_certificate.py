"""Certificates that the domain's root issues to servers for TLS: to the enrolment server, and to doors.

Sans-I/O. Their units ``enrolment`` and ``door`` are no roles of nodes: no member's certificate serves in their place,
nor one of them as a membership. Source: RFC 5280; RFC 5929, section 4 (a hash binds what is said to the connection).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Root
from gdp.crypto.keys import PublicKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import SubjectInfo, bad, read, read_request
from gdp.errors import DropReason, StatementError
from gdp.metadata import Metadata

_UNIT: Final = "enrolment"
_DOOR: Final = "door"


def issue_server_certificate(authority: CertificateAuthority, key: PublicKey, validity: Validity) -> bytes:
    """Return the certificate of a server's key, DER. Raises ``LocalError``: it would outlive the root."""
    label = authority.root.label
    subject = Subject.of(Metadata({"kind": _UNIT, "name": label}), key.compressed)
    return authority.sign(SubjectInfo(subject, _UNIT, label, key), validity)


def issue_door_certificate(
    authority: CertificateAuthority, request: bytes, hosts: Sequence[str], validity: Validity
) -> bytes:
    """Return the certificate, DER, by which the door of a node shows its hosts to clients that trust the root.

    Args:
        request: of the node, PKCS #10, DER or PEM.
        hosts: names and addresses under which clients connect.

    Raises:
        StatementError: the request is not valid.
        LocalError: the certificate would outlive the root, or one of the hosts is none.
    """
    node = read_request(request)
    subject = Subject.of(Metadata({"kind": _DOOR, "name": node.label}), node.key.compressed)
    return authority.sign(SubjectInfo(subject, _DOOR, node.label, node.key), validity, hosts)


def verify_server_certificate(wire: bytes, root: Root, unix_s: float) -> None:
    """Return if the domain's root issued this certificate to its enrolment server, and both are valid now.

    Args:
        wire: DER, as TLS shows it.

    Raises:
        StatementError: BAD_CERTIFICATE, WRONG_NAME, WRONG_DOMAIN or EXPIRED.
    """
    certificate = read(wire)
    if certificate.holder.unit != _UNIT or certificate.is_authority:
        raise bad("not the certificate of an enrolment server")
    if certificate.issuer != root.distinguished_name or certificate.issuer_key_id not in (b"", root.key_id):
        raise StatementError(DropReason.WRONG_DOMAIN, "not issued by this domain")
    try:
        root.key.verify_der(certificate.signature, certificate.signed_bytes)
    except StatementError as error:
        raise bad("the signature does not hold") from error
    root.validity.check(unix_s, "domain root")
    certificate.validity.check(unix_s, "certificate of the enrolment server")


def channel_binding(wire: bytes) -> bytes:
    """Return tls-server-end-point of a connection, 32 bytes, from the server's certificate, DER."""
    return hashlib.sha256(wire).digest()
