"""Certificate authority of one run, and a certificate for every machine of the row, for mutual TLS.

I/O. Writes PEM files. Keys are ECDSA P-256 as in our own certificates, valid for a day.
"""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Iterable, Mapping
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_LIFE = datetime.timedelta(days=1)
_BACK = datetime.timedelta(minutes=5)


def make_certificates(directory: Path, hosts: Mapping[str, Iterable[str]]) -> None:
    """Write ``ca.crt`` and, for each host, ``NAME.crt`` and ``NAME.key``. ``hosts``: IPv4 addresses by name."""
    directory.mkdir(mode=0o700)
    authority, root = ec.generate_private_key(ec.SECP256R1()), _name("bench root")
    basic = x509.BasicConstraints(ca=True, path_length=0)
    signing = _builder(root, root, authority.public_key()).add_extension(basic, critical=True)
    signing = signing.add_extension(_usage(signs_certificates=True), critical=True)
    _write(directory / "ca.crt", signing.sign(authority, hashes.SHA256()))
    for host, addresses in hosts.items():
        key = ec.generate_private_key(ec.SECP256R1())
        names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(each)) for each in addresses])
        purposes = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        certificate = (
            _builder(_name(host), root, key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(purposes, critical=False)
            .add_extension(names, critical=False)
            .sign(authority, hashes.SHA256())
        )
        _write(directory / f"{host}.crt", certificate)
        form = serialization.PrivateFormat.PKCS8
        text = key.private_bytes(serialization.Encoding.PEM, form, serialization.NoEncryption())
        (directory / f"{host}.key").write_bytes(text)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _builder(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.timezone.utc)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACK)
        .not_valid_after(now + _LIFE)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _write(path: Path, certificate: x509.Certificate) -> None:
    path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
