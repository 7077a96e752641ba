"""Ideal signature scheme in place of ECDSA, so that signing, reading and verifying statements costs little.

A signature is BLAKE2b over SHA-256 of the data, keyed by the public key. It is deterministic, 64 bytes long, and only
the harness can make one. A verifier decides as with ECDSA, except for malleated signatures and invalid curve points.
Certificates (X.509) keep their real signatures and their real verification.

All nodes of a simulation are in one process, so the bytes of a statement or a certificate are decoded once for all of
its receivers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Final
from unittest import mock

from gdp.crypto import cbor, certificates, statements, x509_profile
from gdp.crypto.keys import SIGNATURE_BYTES, PublicKey, SigningKey, SoftwareKey
from gdp.errors import DropReason, StatementError

__all__ = ["forget_decoded", "signing_oracle"]

_DECODED_MAX: Final = 1_024


def _signature(compressed: bytes, digest: bytes) -> bytes:
    return hashlib.blake2b(digest, digest_size=SIGNATURE_BYTES, key=compressed).digest()


def _sign(self: SigningKey, data: bytes) -> bytes:
    return _signature(self.public.compressed, hashlib.sha256(data).digest())


def _sign_digest(self: SigningKey, digest: bytes) -> bytes:
    return _signature(self.public.compressed, digest)


def _verify(self: PublicKey, signature: bytes, data: bytes) -> None:
    _verify_digest(self, signature, hashlib.sha256(data).digest())


def _verify_digest(self: PublicKey, signature: bytes, digest: bytes) -> None:
    if signature != _signature(self.compressed, digest):
        raise StatementError(DropReason.BAD_SIGNATURE)


@lru_cache(_DECODED_MAX)
def _decode_once(payload: bytes) -> cbor.Value:
    return cbor.decode(payload)


_read_once: Final = lru_cache(_DECODED_MAX)(x509_profile.read)


def forget_decoded() -> None:
    """Forget what was decoded, for tests that count objects."""
    _decode_once.cache_clear()
    _read_once.cache_clear()


def _decode(payload: bytes) -> cbor.Value:
    value = _decode_once(payload)
    return dict(value) if isinstance(value, dict) else value  # the reader takes the type out


@contextmanager
def signing_oracle() -> Iterator[None]:
    """Replace ECDSA of statements and messages, in this process, for the duration of the context."""
    with (
        mock.patch.object(statements, "decode", _decode),
        mock.patch.object(certificates, "read", _read_once),
        mock.patch.object(SoftwareKey, "sign", _sign),
        mock.patch.object(SoftwareKey, "sign_digest", _sign_digest),
        mock.patch.object(PublicKey, "verify", _verify),
        mock.patch.object(PublicKey, "verify_digest", _verify_digest),
    ):
        yield
