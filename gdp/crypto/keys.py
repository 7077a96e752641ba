"""ECDSA keys on P-256: they sign bytes or a digest of bytes, and prove it.

Place: pure, but for the randomness that the library draws for new keys and signatures.
Source: FIPS 186-5; points in the compressed form of SEC 1, section 2.3.3; signatures as r || s of 32 bytes each (RFC
9053, section 2.1).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import Prehashed, decode_dss_signature, encode_dss_signature

from gdp.errors import DropReason, LocalError, StatementError

__all__ = ["KEY_BYTES", "SIGNATURE_BYTES", "PublicKey", "SigningKey"]

KEY_BYTES: Final = 33
SIGNATURE_BYTES: Final = 64
_HALF: Final = SIGNATURE_BYTES // 2
_ECDSA: Final = ec.ECDSA(hashes.SHA256())
_ECDSA_DIGEST: Final = ec.ECDSA(Prehashed(hashes.SHA256()))


@dataclass(frozen=True, slots=True)
class PublicKey:
    """A point that verifies; equal to another when the compressed bytes are. A verification costs about 70 us."""

    compressed: bytes
    point: ec.EllipticCurvePublicKey = field(repr=False, compare=False)

    def __repr__(self) -> str:
        return f"PublicKey({self.compressed.hex()})"

    @staticmethod
    @lru_cache(maxsize=4_096)
    def from_compressed(compressed: bytes) -> PublicKey:
        """Read 33 bytes; costs about 25 us the first time.

        Raises:
            StatementError: MALFORMED, not a point of P-256 in compressed form.
        """
        if len(compressed) != KEY_BYTES or compressed[0] not in (2, 3):
            raise StatementError(DropReason.MALFORMED, f"a key is {KEY_BYTES} bytes, a compressed point")
        try:
            point = ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), compressed)
        except ValueError as error:
            raise StatementError(DropReason.MALFORMED, "a key that is no point of P-256") from error
        return PublicKey(bytes(compressed), point)

    @classmethod
    def from_point(cls, point: object) -> PublicKey:
        """Take over a library key.

        Raises:
            StatementError: MALFORMED, another kind of key or another curve.
        """
        if not isinstance(point, ec.EllipticCurvePublicKey) or not isinstance(point.curve, ec.SECP256R1):
            raise StatementError(DropReason.MALFORMED, "a key that is not ECDSA P-256")
        form = serialization.Encoding.X962, serialization.PublicFormat.CompressedPoint
        return cls(point.public_bytes(*form), point)

    @classmethod
    def from_pem(cls, pem: bytes) -> PublicKey:
        """Read a SubjectPublicKeyInfo in PEM.

        Raises:
            LocalError: not a P-256 public key in PEM.
        """
        try:
            return cls.from_point(serialization.load_pem_public_key(pem))
        except (ValueError, UnsupportedAlgorithm, StatementError) as error:
            raise LocalError("not a P-256 public key in PEM") from error

    def to_pem(self) -> bytes:
        """Return the SubjectPublicKeyInfo in PEM, as ``openssl pkey -pubin`` reads it."""
        return self.point.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)

    def verify(self, signature: bytes, data: bytes) -> None:
        """Return if ``signature`` (64 bytes, r || s) over SHA-256 of ``data`` is by this key.

        Raises:
            StatementError: BAD_SIGNATURE.
        """
        self._verify(_to_der(signature), data, _ECDSA)

    def verify_digest(self, signature: bytes, digest: bytes) -> None:
        """The same for a SHA-256 digest (32 bytes) that the caller already has.

        Raises:
            StatementError: BAD_SIGNATURE.
        """
        if len(digest) != _HALF:
            raise LocalError("a SHA-256 digest has 32 bytes")
        self._verify(_to_der(signature), digest, _ECDSA_DIGEST)

    def verify_der(self, signature: bytes, data: bytes) -> None:
        """The same for a signature in DER, as X.509 carries it.

        Raises:
            StatementError: BAD_SIGNATURE.
        """
        self._verify(signature, data, _ECDSA)

    def _verify(self, signature: bytes, data: bytes, scheme: ec.ECDSA) -> None:
        try:
            self.point.verify(signature, data, scheme)
        except InvalidSignature as error:
            raise StatementError(DropReason.BAD_SIGNATURE) from error


@dataclass(frozen=True, slots=True)
class SigningKey:
    """A private key; it never appears in a ``repr``. A signature costs about 25 us."""

    private: ec.EllipticCurvePrivateKey = field(repr=False)
    public: PublicKey

    @classmethod
    def generate(cls) -> SigningKey:
        """Return a new key from the system's randomness."""
        return cls._of(ec.generate_private_key(ec.SECP256R1()))

    @classmethod
    def from_pem(cls, pem: bytes) -> SigningKey:
        """Read an unencrypted private key in PEM.

        Raises:
            LocalError: not a P-256 private key in PEM, or one under a password.
        """
        try:
            private = serialization.load_pem_private_key(pem, password=None)
        except TypeError as error:
            raise LocalError("a private key under a password is not supported") from error
        except (ValueError, UnsupportedAlgorithm) as error:
            raise LocalError("not a private key in PEM") from error
        if not isinstance(private, ec.EllipticCurvePrivateKey) or not isinstance(private.curve, ec.SECP256R1):
            raise LocalError("a private key that is not ECDSA P-256")
        return cls._of(private)

    @classmethod
    def _of(cls, private: ec.EllipticCurvePrivateKey) -> SigningKey:
        return cls(private, PublicKey.from_point(private.public_key()))

    def to_pem(self) -> bytes:
        """Return the key in PKCS #8 PEM, unencrypted: the caller guards it."""
        return self.private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )

    def sign(self, data: bytes) -> bytes:
        """Return r || s (64 bytes) over SHA-256 of ``data``."""
        return _from_der(self.private.sign(data, _ECDSA))

    def sign_digest(self, digest: bytes) -> bytes:
        """Return r || s (64 bytes) over a SHA-256 digest (32 bytes).

        Raises:
            LocalError: not 32 bytes.
        """
        if len(digest) != _HALF:
            raise LocalError("a SHA-256 digest has 32 bytes")
        return _from_der(self.private.sign(digest, _ECDSA_DIGEST))


def _to_der(signature: bytes) -> bytes:
    if len(signature) != SIGNATURE_BYTES:
        raise StatementError(DropReason.BAD_SIGNATURE, f"{len(signature)} bytes, not {SIGNATURE_BYTES}")
    return encode_dss_signature(int.from_bytes(signature[:_HALF], "big"), int.from_bytes(signature[_HALF:], "big"))


def _from_der(signature: bytes) -> bytes:
    r, s = decode_dss_signature(signature)
    return r.to_bytes(_HALF, "big") + s.to_bytes(_HALF, "big")
