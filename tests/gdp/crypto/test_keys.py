"""ECDSA keys."""

from __future__ import annotations

import hashlib

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.errors import DropReason, LocalError, StatementError

KEY = SigningKey.generate()
# RFC 6979, appendix A.2.5: key, message "sample", SHA-256
RFC6979_KEY = 0xC9AFA9D845BA75166B5C215767B1D6934E50C3DB36E89B127B8A622B120F6721
RFC6979_PUBLIC = "0360fed4ba255a9d31c961eb74c6356d68c049b8923b61fa6ce669622e60f29fb6"
RFC6979_SIGNATURE = (
    "efd48b2aacb6a8fd1140dd9cd45e81d69d2c877b56aaf991c34d0ea84eaf3716"
    "f7cb1c942d657c41d436c7a1b6e29f65f3e900dbb9aff4064dc4ab2f843acda8"
)


def pem_of(private: object, password: bytes | None = None) -> bytes:
    encryption = serialization.BestAvailableEncryption(password) if password else serialization.NoEncryption()
    return private.private_bytes(  # type: ignore[attr-defined, no-any-return]
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption
    )


def reason_of(caught: pytest.ExceptionInfo[StatementError]) -> DropReason:
    return caught.value.reason


def test_a_published_signature_verifies() -> None:
    PublicKey.from_compressed(bytes.fromhex(RFC6979_PUBLIC)).verify(bytes.fromhex(RFC6979_SIGNATURE), b"sample")


def test_a_published_private_key_has_the_published_public_key() -> None:
    key = SigningKey.from_pem(pem_of(ec.derive_private_key(RFC6979_KEY, ec.SECP256R1())))
    assert key.public.compressed.hex() == RFC6979_PUBLIC


@given(st.binary(max_size=64))
def test_what_a_key_signs_it_verifies(data: bytes) -> None:
    signature = KEY.sign(data)
    assert len(signature) == 64
    KEY.public.verify(signature, data)


def test_signing_a_digest_is_signing_the_data() -> None:
    digest = hashlib.sha256(b"data").digest()
    KEY.public.verify(KEY.sign_digest(digest), b"data")
    KEY.public.verify_digest(KEY.sign(b"data"), digest)


@given(st.binary(max_size=80) | st.binary(min_size=64, max_size=64))
def test_arbitrary_bytes_are_no_signature(signature: bytes) -> None:
    with pytest.raises(StatementError) as caught:
        KEY.public.verify(signature, b"data")
    assert reason_of(caught) is DropReason.BAD_SIGNATURE


def test_another_key_does_not_verify() -> None:
    with pytest.raises(StatementError) as caught:
        SigningKey.generate().public.verify(KEY.sign(b"data"), b"data")
    assert reason_of(caught) is DropReason.BAD_SIGNATURE


@given(st.binary(max_size=40) | st.binary(min_size=33, max_size=33))
def test_arbitrary_bytes_are_a_point_or_malformed(raw: bytes) -> None:
    reason, key = None, None
    try:
        key = PublicKey.from_compressed(raw)
    except StatementError as error:
        reason = error.reason
    assert reason is DropReason.MALFORMED if key is None else key.compressed == raw


@pytest.mark.parametrize(
    "raw",
    [b"", b"\x00", b"\x02" + b"\xff" * 32, b"\x04" + bytes(64), b"\x05" + bytes(32), b"\x02" + bytes(31)],
    ids=["empty", "infinity", "beyond the field", "uncompressed", "unknown form", "short"],
)
def test_what_is_no_compressed_point_is_malformed(raw: bytes) -> None:
    with pytest.raises(StatementError) as caught:
        PublicKey.from_compressed(raw)
    assert reason_of(caught) is DropReason.MALFORMED


def test_both_keys_come_back_from_their_files() -> None:
    assert SigningKey.from_pem(KEY.to_pem()).public == KEY.public == PublicKey.from_pem(KEY.public.to_pem())


@pytest.mark.parametrize(
    "pem",
    [
        b"",
        b"nonsense",
        pem_of(ec.generate_private_key(ec.SECP384R1())),
        pem_of(ed25519.Ed25519PrivateKey.generate()),
        pem_of(ec.generate_private_key(ec.SECP256R1()), b"password"),
    ],
    ids=["empty", "nonsense", "another curve", "another kind", "a password"],
)
def test_another_private_key_is_our_own_mistake(pem: bytes) -> None:
    with pytest.raises(LocalError):
        SigningKey.from_pem(pem)


def test_another_public_key_is_our_own_mistake() -> None:
    with pytest.raises(LocalError):
        PublicKey.from_pem(KEY.to_pem())


@pytest.mark.parametrize("digest", [b"", bytes(31), bytes(33)])
def test_a_digest_of_another_length_is_our_own_mistake(digest: bytes) -> None:
    with pytest.raises(LocalError):
        KEY.sign_digest(digest)
    with pytest.raises(LocalError):
        KEY.public.verify_digest(bytes(64), digest)


def test_a_repr_shows_nothing_private() -> None:
    number = KEY.private.private_numbers().private_value
    assert str(number) not in repr(KEY)
    assert "private" not in repr(KEY)
