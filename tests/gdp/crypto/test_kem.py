"""Hybrid key that receives secrets."""

from __future__ import annotations

import builtins
from collections.abc import Iterator

import pytest

from gdp.crypto import kem
from gdp.crypto.kem import KEM_PUBLIC_BYTES, KemPrivateKey, KemPublicKey
from gdp.errors import DropReason, LocalError, StatementError

KEY = KemPrivateKey.generate()


@pytest.fixture
def old_library(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    real = builtins.__import__

    def without(name: str, *rest: object) -> object:
        if name == "cryptography.hazmat.primitives" and "hpke" in (rest[2] or ()):  # type: ignore[operator]
            raise ImportError(name)
        return real(name, *rest)  # type: ignore[arg-type]

    kem._library.cache_clear()
    monkeypatch.setattr(builtins, "__import__", without)
    yield
    kem._library.cache_clear()


def test_what_is_sealed_to_a_key_it_opens() -> None:
    assert KEY.open(KEY.public.seal(b"secret", b"info"), b"info") == b"secret"


def test_the_same_secret_is_sealed_differently_each_time() -> None:
    assert KEY.public.seal(b"secret", b"info") != KEY.public.seal(b"secret", b"info")


def test_a_key_comes_back_from_its_bytes() -> None:
    again = KemPrivateKey.from_wire(KEY.wire)
    assert again.open(KemPublicKey.from_wire(KEY.public.wire).seal(b"secret", b""), b"") == b"secret"


@pytest.mark.parametrize("at", [0, 600, 1_100, 1_125, -1])
def test_an_altered_secret_does_not_open(at: int) -> None:
    sealed = bytearray(KEY.public.seal(b"secret", b"info"))
    sealed[at] ^= 1
    with pytest.raises(StatementError) as caught:
        KEY.open(bytes(sealed), b"info")
    assert caught.value.reason is DropReason.BAD_TAG


@pytest.mark.parametrize("sealed", [b"", bytes(1_168), b"short"])
def test_what_was_never_sealed_does_not_open(sealed: bytes) -> None:
    with pytest.raises(StatementError) as caught:
        KEY.open(sealed, b"info")
    assert caught.value.reason is DropReason.BAD_TAG


def test_other_info_does_not_open() -> None:
    with pytest.raises(StatementError):
        KEY.open(KEY.public.seal(b"secret", b"info"), b"other")


def test_another_key_does_not_open() -> None:
    with pytest.raises(StatementError):
        KemPrivateKey.generate().open(KEY.public.seal(b"secret", b"info"), b"info")


@pytest.mark.parametrize("size", [0, KEM_PUBLIC_BYTES - 1, KEM_PUBLIC_BYTES + 1])
def test_a_public_key_of_another_length_is_malformed(size: int) -> None:
    with pytest.raises(StatementError) as caught:
        KemPublicKey.from_wire(bytes(size))
    assert caught.value.reason is DropReason.MALFORMED


@pytest.mark.parametrize("byte", [b"\x00", b"\xff"])
def test_nothing_is_sealed_to_what_is_no_key(byte: bytes) -> None:
    with pytest.raises(StatementError) as caught:
        KemPublicKey.from_wire(byte * KEM_PUBLIC_BYTES).seal(b"secret", b"info")
    assert caught.value.reason is DropReason.MALFORMED


def test_a_private_key_of_another_length_is_our_own_mistake() -> None:
    with pytest.raises(LocalError):
        KemPrivateKey.from_wire(bytes(95))


def test_a_library_without_the_kem_is_named(old_library: None) -> None:
    with pytest.raises(LocalError, match="version 48"):
        KemPrivateKey.generate()


def test_a_repr_shows_nothing_private() -> None:
    assert repr(KEY.wire) not in repr(KEY)
    assert "wire" not in repr(KEY)
