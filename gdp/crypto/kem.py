"""KEM key of a node for receiving secrets: a hybrid of ML-KEM-768 and X25519.

The hybrid keeps recorded secrets closed against later attacks on one of the two.

Sans-I/O except for the randomness that the library draws. Source: HPKE, RFC 9180, single-shot, base mode, with KEM
MLKEM768-X25519, HKDF-SHA256 and AES-256-GCM. On the wire::

    private  ML-KEM seed (64) || X25519 (32)
    public   ML-KEM (1184) || X25519 (32)
    sealed   encapsulated key (1120) || ciphertext || tag (16)

The library has this from version 47 on, its wheels from 48. Where it is missing, each call raises ``LocalError``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

from cryptography.exceptions import InvalidTag, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import x25519

from gdp.crypto.schema import mapped, octets
from gdp.errors import DropReason, LocalError, StatementError

_SEED_BYTES: Final = 64
_MLKEM_PUBLIC_BYTES: Final = 1_184
_X25519_BYTES: Final = 32
KEM_PRIVATE_BYTES: Final = _SEED_BYTES + _X25519_BYTES
KEM_PUBLIC_BYTES: Final = _MLKEM_PUBLIC_BYTES + _X25519_BYTES
SEALING_BYTES: Final = 1_120 + 16  # of what is sealed above its secret
_TOO_OLD: Final = "handing over topic secrets needs the package cryptography, version 48 or later, with ML-KEM"


@dataclass(frozen=True, slots=True)
class KemPublicKey:
    """Public key to seal a secret to. A sealing costs about 0.2 ms."""

    wire: bytes = field(repr=False)

    @classmethod
    def from_wire(cls, wire: bytes) -> KemPublicKey:
        """Read ``KEM_PUBLIC_BYTES``; the first use shows whether they are a key.

        Raises:
            StatementError: MALFORMED, another length.
        """
        if len(wire) != KEM_PUBLIC_BYTES:
            raise StatementError(DropReason.MALFORMED, f"a public KEM key has {KEM_PUBLIC_BYTES} bytes")
        return cls(wire)

    def seal(self, secret: bytes, info: bytes) -> bytes:
        """Return ``secret`` sealed to this key; the same ``info`` is needed to open it.

        Raises:
            StatementError: MALFORMED, the bytes are no key.
        """
        library = _library()
        try:
            key = library.hpke.MLKEM768X25519PublicKey(
                library.mlkem.MLKEM768PublicKey.from_public_bytes(self.wire[:_MLKEM_PUBLIC_BYTES]),
                x25519.X25519PublicKey.from_public_bytes(self.wire[_MLKEM_PUBLIC_BYTES:]),
            )
            return library.suite.encrypt(secret, key, info)
        except ValueError as error:  # also a point of small order
            raise StatementError(DropReason.MALFORMED, "not a public KEM key") from error


KEM_PUBLIC: Final = mapped(octets(KEM_PUBLIC_BYTES), KemPublicKey, lambda key: key.wire)


@dataclass(frozen=True, slots=True)
class KemPrivateKey:
    """Private key; it never appears in a ``repr``."""

    wire: bytes = field(repr=False)
    public: KemPublicKey

    @classmethod
    def generate(cls) -> KemPrivateKey:
        """Return a new key from the system's randomness."""
        seed = _library().mlkem.MLKEM768PrivateKey.generate().private_bytes_raw()
        return cls.from_wire(seed + x25519.X25519PrivateKey.generate().private_bytes_raw())

    @classmethod
    def from_wire(cls, wire: bytes) -> KemPrivateKey:
        """Read ``KEM_PRIVATE_BYTES``.

        Raises:
            LocalError: another length, or the installed library has no such KEM.
        """
        if len(wire) != KEM_PRIVATE_BYTES:
            raise LocalError(f"a private KEM key has {KEM_PRIVATE_BYTES} bytes, not {len(wire)}")
        seed, scalar = wire[:_SEED_BYTES], wire[_SEED_BYTES:]
        public = _library().mlkem.MLKEM768PrivateKey.from_seed_bytes(seed).public_key().public_bytes_raw()
        public += x25519.X25519PrivateKey.from_private_bytes(scalar).public_key().public_bytes_raw()
        return cls(wire, KemPublicKey(public))

    def open(self, sealed: bytes, info: bytes) -> bytes:
        """Return the secret that was sealed to this key under the same ``info``.

        Raises:
            StatementError: BAD_TAG, it was sealed to another, or altered.
        """
        library = _library()
        key = library.hpke.MLKEM768X25519PrivateKey(
            library.mlkem.MLKEM768PrivateKey.from_seed_bytes(self.wire[:_SEED_BYTES]),
            x25519.X25519PrivateKey.from_private_bytes(self.wire[_SEED_BYTES:]),
        )
        try:
            return library.suite.decrypt(sealed, key, info)
        except (InvalidTag, ValueError) as error:
            raise StatementError(DropReason.BAD_TAG, "a secret that is not sealed to this node") from error


class _Library:
    """The parts of the library that older versions lack."""

    def __init__(self) -> None:
        from cryptography.hazmat.primitives import hpke
        from cryptography.hazmat.primitives.asymmetric import mlkem

        self.hpke = hpke
        self.mlkem = mlkem
        self.suite = hpke.Suite(hpke.KEM.MLKEM768_X25519, hpke.KDF.HKDF_SHA256, hpke.AEAD.AES_256_GCM)
        mlkem.MLKEM768PrivateKey.generate()  # a back end without ML-KEM raises only here


@lru_cache(maxsize=1)
def _library() -> _Library:
    try:
        return _Library()
    except (ImportError, AttributeError, UnsupportedAlgorithm) as error:
        raise LocalError(_TOO_OLD) from error
