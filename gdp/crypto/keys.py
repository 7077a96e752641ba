"""ECDSA keys on P-256: they sign bytes or a SHA-256 digest, and verify signatures.

Sans-I/O except for the randomness that the library draws for new keys and signatures. Source: FIPS 186-5; points in the
compressed form of SEC 1, section 2.3.3; signatures as r || s of 32 bytes each (RFC 9053, section 2.1).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import Prehashed, decode_dss_signature, encode_dss_signature

from gdp.errors import DropReason, LocalError, StatementError

KEY_BYTES: Final = 33
SIGNATURE_BYTES: Final = 64
WRONG_PASSPHRASE: Final = "does not open: a wrong passphrase, or the file was altered"
_HALF: Final = SIGNATURE_BYTES // 2
_HALF_BITS: Final = 8 * _HALF
_ECDSA: Final = ec.ECDSA(hashes.SHA256())
_ECDSA_DIGEST: Final = ec.ECDSA(Prehashed(hashes.SHA256()))


@dataclass(frozen=True, slots=True)
class PublicKey:
    """Public key; equal to another when the compressed bytes are.

    A verification costs about 70 us. It raises ``StatementError`` (BAD_SIGNATURE) if the signature is not by this key.
    """

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
        """Wrap a library key. Raises ``StatementError``: MALFORMED, another kind of key or another curve."""
        if not isinstance(point, ec.EllipticCurvePublicKey) or not isinstance(point.curve, ec.SECP256R1):
            raise StatementError(DropReason.MALFORMED, "a key that is not ECDSA P-256")
        form = serialization.Encoding.X962, serialization.PublicFormat.CompressedPoint
        return cls(point.public_bytes(*form), point)

    @classmethod
    def from_pem(cls, pem: bytes) -> PublicKey:
        """Read a SubjectPublicKeyInfo in PEM. Raises ``LocalError``: not a P-256 public key in PEM."""
        try:
            return cls.from_point(serialization.load_pem_public_key(pem))
        except (ValueError, UnsupportedAlgorithm, StatementError) as error:
            raise LocalError("not a P-256 public key in PEM") from error

    def to_pem(self) -> bytes:
        """Return the SubjectPublicKeyInfo in PEM, as ``openssl pkey -pubin`` reads it."""
        return self.point.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)

    def verify(self, signature: bytes, data: bytes) -> None:
        """Return if ``signature`` (64 bytes, r || s) over SHA-256 of ``data`` is by this key."""
        self._verify(_to_der(signature), data, _ECDSA)

    def verify_digest(self, signature: bytes, digest: bytes) -> None:
        """Return if ``signature`` over a SHA-256 digest (32 bytes) is by this key."""
        if len(digest) != _HALF:
            raise LocalError("a SHA-256 digest has 32 bytes")
        self._verify(_to_der(signature), digest, _ECDSA_DIGEST)

    def verify_der(self, signature: bytes, data: bytes) -> None:
        """Return if ``signature`` in DER, as X.509 carries it, over ``data`` is by this key."""
        self._verify(signature, data, _ECDSA)

    def _verify(self, signature: bytes, data: bytes, scheme: ec.ECDSA) -> None:
        try:
            self.point.verify(signature, data, scheme)
        except InvalidSignature as error:
            raise StatementError(DropReason.BAD_SIGNATURE) from error


class SigningKey(ABC):
    """A private key: in this process (``SoftwareKey``), or in a token that signs by itself."""

    __slots__ = ()
    public: PublicKey

    @staticmethod
    def generate() -> SoftwareKey:
        """Return a new key of this process, from the system's randomness."""
        return SoftwareKey.of(ec.generate_private_key(ec.SECP256R1()))

    @staticmethod
    def from_pem(pem: bytes, passphrase: bytes | None = None) -> SoftwareKey:
        """Read a private key in PEM.

        Args:
            pem: PKCS #8, encrypted or not, or the older form of OpenSSL.
            passphrase: opens an encrypted one; ignored where the key is not encrypted.

        Raises:
            LocalError: not a P-256 private key in PEM, or it does not open with this passphrase.
        """
        try:
            private = _load(pem, passphrase)
        except (ValueError, UnsupportedAlgorithm) as error:
            if is_encrypted(pem):
                raise LocalError(WRONG_PASSPHRASE) from error
            raise LocalError("not a private key in PEM") from error
        return _software_key(private)

    @staticmethod
    def from_der(der: bytes) -> SoftwareKey:
        """Read a private key in PKCS #8, DER, unencrypted. Raises ``LocalError``: not a P-256 private key."""
        try:
            private = serialization.load_der_private_key(der, password=None)
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise LocalError("not a private key in DER") from error
        return _software_key(private)

    @abstractmethod
    def sign(self, data: bytes) -> bytes:
        """Return r || s (64 bytes) over SHA-256 of ``data``."""

    @abstractmethod
    def sign_digest(self, digest: bytes) -> bytes:
        """Return r || s (64 bytes) over a SHA-256 digest (32 bytes). Raises ``LocalError``: not 32 bytes."""

    def sign_der(self, data: bytes) -> bytes:
        """Return the signature over SHA-256 of ``data`` in DER, as X.509 carries it."""
        return _to_der(self.sign(data))

    @abstractmethod
    def to_file(self, protect: Callable[[bytes], bytes] | None = None) -> bytes:
        """Return the content of this key's private file, in PEM.

        Args:
            protect: encrypts a PrivateKeyInfo, DER; without it the caller guards the file.
        """


@dataclass(frozen=True, slots=True)
class SoftwareKey(SigningKey):
    """A private key in this process; it never appears in a ``repr``. A signature costs about 25 us."""

    private: ec.EllipticCurvePrivateKey = field(repr=False)
    public: PublicKey

    @classmethod
    def of(cls, private: ec.EllipticCurvePrivateKey) -> SoftwareKey:
        """Wrap a library key on P-256."""
        return cls(private, PublicKey.from_point(private.public_key()))

    def to_pem(self) -> bytes:
        """Return the key in PKCS #8 PEM, unencrypted: the caller guards it."""
        return self.private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )

    def to_file(self, protect: Callable[[bytes], bytes] | None = None) -> bytes:
        """Return the content of this key's private file, in PEM; ``protect`` encrypts a PrivateKeyInfo, DER."""
        if protect is None:
            return self.to_pem()
        form = serialization.Encoding.DER, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        return protect(self.private.private_bytes(*form))

    def sign(self, data: bytes) -> bytes:
        """Return r || s (64 bytes) over SHA-256 of ``data``; costs about 25 us."""
        return _from_der(self.private.sign(data, _ECDSA))

    def sign_digest(self, digest: bytes) -> bytes:
        """Return r || s (64 bytes) over a SHA-256 digest. Raises ``LocalError``: not 32 bytes."""
        if len(digest) != _HALF:
            raise LocalError("a SHA-256 digest has 32 bytes")
        return _from_der(self.private.sign(digest, _ECDSA_DIGEST))


def _software_key(private: object) -> SoftwareKey:
    if not isinstance(private, ec.EllipticCurvePrivateKey) or not isinstance(private.curve, ec.SECP256R1):
        raise LocalError("a private key that is not ECDSA P-256")
    return SoftwareKey.of(private)


def is_encrypted(pem: bytes) -> bool:
    """Return whether a private key in PEM needs a passphrase."""
    return b"ENCRYPTED" in pem


def _load(pem: bytes, passphrase: bytes | None) -> object:
    if not is_encrypted(pem):
        return serialization.load_pem_private_key(pem, password=None)
    if passphrase is None:
        raise LocalError("is protected by a passphrase, and none was given")
    return serialization.load_pem_private_key(pem, passphrase)


def _to_der(signature: bytes) -> bytes:
    if len(signature) != SIGNATURE_BYTES:
        raise StatementError(DropReason.BAD_SIGNATURE, f"{len(signature)} bytes, not {SIGNATURE_BYTES}")
    both = int.from_bytes(signature, "big")
    return encode_dss_signature(both >> _HALF_BITS, both & (1 << _HALF_BITS) - 1)


def _from_der(signature: bytes) -> bytes:
    r, s = decode_dss_signature(signature)
    return (r << _HALF_BITS | s).to_bytes(SIGNATURE_BYTES, "big")
