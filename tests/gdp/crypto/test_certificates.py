"""Roots and memberships: valid and invalid ones, and agreement with OpenSSL."""

from __future__ import annotations

import shutil
import subprocess
import time
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.asymmetric.utils import decode_dss_signature, encode_dss_signature
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.ca import CertificateAuthority, request_membership
from gdp.crypto.certificates import Membership, Role, Root, Unverified
from gdp.crypto.identity import node_metadata
from gdp.crypto.keys import SigningKey
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import alternative_names, read_request, to_pem
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata

NOW = 1_800_000_000
YEAR = Validity(NOW, NOW + 365 * 86_400)
MONTH = Validity(NOW, NOW + 30 * 86_400)
SCHOOL_KEY = SigningKey.generate()
SCHOOL = CertificateAuthority.create("school", SCHOOL_KEY, YEAR)
DIGEST = node_metadata(Role.PROXY, "robot").digest()
KEY = SigningKey.generate()
REQUEST = request_membership(KEY, Role.PROXY, "robot", DIGEST)
MEMBER = SCHOOL.issue(REQUEST, MONTH)
FOREIGN = (DropReason.BAD_CERTIFICATE, DropReason.WRONG_NAME, DropReason.WRONG_DOMAIN, DropReason.EXPIRED)


def reason(wire: bytes, root: Root = SCHOOL.root, unix_s: float = NOW) -> DropReason:
    with pytest.raises(StatementError) as caught:
        Membership.from_wire(wire, root, unix_s)
    return caught.value.reason


def test_a_membership_says_who_the_node_is() -> None:
    assert (MEMBER.role, MEMBER.label, MEMBER.domain) == (Role.PROXY, "robot", SCHOOL.root.domain)
    assert (MEMBER.digest, MEMBER.key, MEMBER.validity) == (DIGEST, KEY.public, MONTH)


def test_a_leaf_is_a_switch_by_another_role_and_name() -> None:
    request = {role: request_membership(KEY, role, "robot", node_metadata(role, "robot").digest()) for role in Role}
    leaf, switch = (SCHOOL.issue(request[role], MONTH) for role in (Role.LEAF, Role.SWITCH))
    assert (leaf.role, switch.role) == (Role.LEAF, Role.SWITCH)
    assert [role for role in Role if role.is_switch] == [Role.SWITCH, Role.LEAF]
    assert leaf.name != switch.name


def test_its_name_comes_from_its_metadata_and_key() -> None:
    assert MEMBER.name == Metadata({"kind": "proxy", "name": "robot"}).name(KEY.public.compressed)


def test_a_domain_is_named_by_its_label_and_root_key() -> None:
    metadata = Metadata({"kind": "domain", "name": "school"})
    assert SCHOOL.root.domain == metadata.name(SCHOOL.key.public.compressed)


def test_der_and_pem_are_read_alike() -> None:
    assert Membership.from_wire(to_pem(MEMBER.wire), SCHOOL.root, NOW) == MEMBER
    assert Root.from_wire(to_pem(SCHOOL.root.wire)) == SCHOOL.root


def test_a_domain_of_the_same_label_does_not_vouch_for_it() -> None:
    other = CertificateAuthority.create("school", SigningKey.generate(), YEAR)
    assert reason(MEMBER.wire, other.root) is DropReason.WRONG_DOMAIN


def test_a_domain_of_another_label_does_not_vouch_for_it() -> None:
    other = CertificateAuthority.create("cloud", SigningKey.generate(), YEAR)
    assert reason(MEMBER.wire, other.root) is DropReason.WRONG_DOMAIN


@pytest.mark.parametrize("unix_s", [NOW - 4_000, NOW + 31 * 86_400])
def test_outside_its_validity_it_does_not_hold(unix_s: int) -> None:
    assert reason(MEMBER.wire, unix_s=unix_s) is DropReason.EXPIRED


def test_a_forged_signature_does_not_hold() -> None:
    forged = bytearray(MEMBER.wire)
    forged[-1] ^= 1
    assert reason(bytes(forged)) is DropReason.BAD_CERTIFICATE


def test_a_second_signature_leaves_the_fingerprint_as_it_is() -> None:
    certificate = x509.load_der_x509_certificate(MEMBER.wire)
    order = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551
    r, s = decode_dss_signature(certificate.signature)
    flipped = encode_dss_signature(r, order - s)
    body = certificate.tbs_certificate_bytes + bytes.fromhex("300a06082a8648ce3d040302")
    body += b"\x03" + bytes((len(flipped) + 1,)) + b"\x00" + flipped
    wire = b"\x30\x82" + len(body).to_bytes(2, "big") + body
    converter = Membership.from_wire(wire, SCHOOL.root, NOW)
    assert converter.wire != MEMBER.wire
    assert converter.fingerprint == MEMBER.fingerprint


@given(st.integers(0, len(MEMBER.wire) - 1), st.integers(1, 255))
def test_every_changed_byte_is_refused_with_a_reason(at: int, change: int) -> None:
    altered = bytearray(MEMBER.wire)
    altered[at] ^= change
    assert reason(bytes(altered)) in FOREIGN


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_no_certificate(wire: bytes) -> None:
    assert reason(wire) is DropReason.BAD_CERTIFICATE
    with pytest.raises(StatementError):
        read_request(wire)


@given(st.integers(0, len(SCHOOL.root.wire) - 1), st.integers(1, 255))
def test_every_changed_byte_of_a_root_is_refused(at: int, change: int) -> None:
    altered = bytearray(SCHOOL.root.wire)
    altered[at] ^= change
    with pytest.raises(StatementError) as caught:
        Root.from_wire(bytes(altered))
    assert caught.value.reason in FOREIGN


def test_a_root_is_no_membership_and_a_membership_no_root() -> None:
    assert reason(SCHOOL.root.wire) is DropReason.BAD_CERTIFICATE
    with pytest.raises(StatementError) as caught:
        Root.from_wire(MEMBER.wire)
    assert caught.value.reason is DropReason.BAD_CERTIFICATE


def certificate(
    *,
    key: SigningKey | None = None,
    subject: Subject | None = None,
    names: x509.SubjectAlternativeName | None = None,
    unit: str | None = "proxy",
    label: str = "robot",
    extension: x509.ExtensionType | None = None,
    public: object = None,
    digest: hashes.SHA256 | hashes.SHA512 | None = None,
) -> bytes:
    """Return a certificate by the school's root that may break any rule."""
    key = key or KEY
    subject = subject or Subject(DIGEST, key.public.compressed)
    attributes = [x509.NameAttribute(NameOID.COMMON_NAME, label)]
    if unit is not None:
        attributes.append(x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, unit))
    begin = datetime.fromtimestamp(NOW, timezone.utc)
    builder = (
        x509.CertificateBuilder()
        .serial_number(1)
        .issuer_name(x509.load_der_x509_certificate(SCHOOL.root.wire).subject)
        .subject_name(x509.Name(attributes))
        .public_key(public or key.public.point)  # type: ignore[arg-type]
        .not_valid_before(begin)
        .not_valid_after(begin + timedelta(days=1))
        .add_extension(names or alternative_names(subject), critical=False)
    )
    if extension is not None:
        builder = builder.add_extension(extension, critical=True)
    return builder.sign(SCHOOL_KEY.private, digest or hashes.SHA256()).public_bytes(Encoding.DER)


def uris(*values: str) -> x509.SubjectAlternativeName:
    return x509.SubjectAlternativeName([x509.UniformResourceIdentifier(value) for value in values])


def test_the_builder_of_the_following_cases_is_right() -> None:
    assert Membership.from_wire(certificate(), SCHOOL.root, NOW).name == MEMBER.name


def test_a_name_of_another_key_is_a_wrong_name() -> None:
    other = Subject(DIGEST, SigningKey.generate().public.compressed)
    assert reason(certificate(subject=other)) is DropReason.WRONG_NAME


def test_a_name_of_other_metadata_is_a_wrong_name() -> None:
    names = uris(f"gdp:{MEMBER.name.hex()}", f"gdp-metadata:{bytes(32).hex()}")
    assert reason(certificate(names=names)) is DropReason.WRONG_NAME


@pytest.mark.parametrize(
    "wire",
    [
        certificate(unit=None),
        certificate(unit="king"),
        certificate(unit="domain"),
        certificate(label="a\x07b"),
        certificate(names=uris("https://example.org")),
        certificate(names=uris(f"gdp:{MEMBER.name.hex()}")),
        certificate(names=uris(f"gdp:{MEMBER.name.hex()}", "gdp-metadata:12")),
        certificate(names=uris(*[f"gdp:{MEMBER.name.hex()}"] * 2, f"gdp-metadata:{DIGEST.hex()}")),
        certificate(extension=x509.BasicConstraints(ca=True, path_length=None)),
        certificate(extension=x509.UnrecognizedExtension(x509.ObjectIdentifier("1.2.3.4"), b"\x05\x00")),
        certificate(public=ec.generate_private_key(ec.SECP384R1()).public_key()),
        certificate(public=ed25519.Ed25519PrivateKey.generate().public_key()),
        certificate(digest=hashes.SHA512()),
        MEMBER.wire + b"\x00",
        MEMBER.wire + bytes(5_000),
    ],
    ids=[
        "no role",
        "an unknown role",
        "a domain as a node",
        "a bell in the label",
        "no name",
        "no digest",
        "a short digest",
        "two names",
        "an authority",
        "a critical extension",
        "another curve",
        "another kind of key",
        "another hash",
        "a byte too many",
        "too long",
    ],
)
def test_other_forms_are_bad_certificates(wire: bytes) -> None:
    assert reason(wire) is DropReason.BAD_CERTIFICATE


def test_a_membership_cannot_outlive_its_root() -> None:
    with pytest.raises(LocalError):
        SCHOOL.issue(REQUEST, Validity(NOW, YEAR.not_after_unix_s + 1))


def test_a_request_for_a_domain_is_refused() -> None:
    subject = SCHOOL.root.subject
    attributes = [
        x509.NameAttribute(NameOID.COMMON_NAME, "school"),
        x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, "domain"),
    ]
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name(attributes))
        .add_extension(alternative_names(subject), critical=False)
        .sign(SCHOOL_KEY.private, hashes.SHA256())
    )
    with pytest.raises(StatementError) as caught:
        SCHOOL.issue(request.public_bytes(Encoding.PEM), MONTH)
    assert caught.value.reason is DropReason.BAD_CERTIFICATE


def test_a_request_signed_by_another_key_is_refused() -> None:
    der = x509.load_pem_x509_csr(REQUEST).public_bytes(Encoding.DER)
    forged = bytearray(der)
    forged[-1] ^= 1
    with pytest.raises(StatementError) as caught:
        SCHOOL.issue(bytes(forged), MONTH)
    assert caught.value.reason is DropReason.BAD_CERTIFICATE


@pytest.mark.parametrize("label", ["", "x" * 65, "a\nb"])
def test_a_label_that_cannot_be_is_our_own_mistake(label: str) -> None:
    with pytest.raises(LocalError):
        CertificateAuthority.create(label, SigningKey.generate(), YEAR)
    with pytest.raises(LocalError):
        request_membership(KEY, Role.RIB, label, DIGEST)


def test_a_root_with_another_key_is_no_authority() -> None:
    with pytest.raises(LocalError):
        CertificateAuthority(KEY, SCHOOL.root)


def test_an_unverified_membership_has_its_name_proved() -> None:
    assert Unverified.from_wire(MEMBER.wire).subject == MEMBER.subject


needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl command here")


def openssl(*arguments: str | Path) -> str:
    done = subprocess.run(["openssl", *map(str, arguments)], capture_output=True, text=True, check=True)
    return done.stdout


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "root.crt").write_bytes(to_pem(SCHOOL.root.wire))
    (tmp_path / "node.crt").write_bytes(to_pem(MEMBER.wire))
    return tmp_path


@needs_openssl
def test_openssl_verifies_what_is_issued_here(files: Path) -> None:
    at = ("-attime", str(NOW + 60))
    assert "OK" in openssl("verify", "-x509_strict", *at, "-CAfile", files / "root.crt", files / "node.crt")


@needs_openssl
def test_openssl_reads_name_role_and_label(files: Path) -> None:
    text = openssl("x509", "-in", files / "node.crt", "-noout", "-text")
    assert f"URI:gdp:{MEMBER.name.to_text()}" in text
    assert f"URI:gdp-metadata:{DIGEST.hex()}" in text
    assert "OU = proxy, CN = robot" in text or "OU=proxy, CN=robot" in text


@needs_openssl
def test_a_membership_issued_by_openssl_holds_here(tmp_path: Path) -> None:
    now = time.time()  # openssl uses the real clock
    authority_key = SigningKey.generate()
    authority = CertificateAuthority.create("school", authority_key, Validity.lasting(now - 60, 86_400))
    root, key, request, out = (tmp_path / name for name in ("root.crt", "root.key", "node.csr", "node.crt"))
    root.write_bytes(to_pem(authority.root.wire))
    key.write_bytes(authority_key.to_pem())
    request.write_bytes(REQUEST)
    issuer = ("-CA", root, "-CAkey", key, "-set_serial", "7")
    openssl("x509", "-req", "-in", request, *issuer, "-copy_extensions", "copy", "-days", "1", "-out", out)
    member = Membership.from_wire(out.read_bytes(), authority.root, now)
    assert (member.name, member.role) == (MEMBER.name, Role.PROXY)
