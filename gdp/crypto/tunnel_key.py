"""WireGuard key of a node: it follows from the node's KEM key, so that nothing more is stored or configured.

Sans-I/O. Source: HKDF (RFC 5869), X25519 (RFC 7748). The KEM key is always in this process, also where a token holds
the signing key. The node's signed endpoint record carries the public half.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.kem import KemPrivateKey

TUNNEL_KEY_BYTES: Final = 32


@dataclass(frozen=True, slots=True)
class TunnelKey:
    """An X25519 key pair, ``TUNNEL_KEY_BYTES`` each; the private half never appears in a ``repr``."""

    private: bytes = field(repr=False)
    public: bytes

    @classmethod
    def derive(cls, kem: KemPrivateKey, uplink: int = 0) -> TunnelKey:
        """Return the key of a node's tunnels over one of its uplinks, numbered from 0."""
        info = b"gdp-tunnel-wireguard-1" + bytes([uplink])
        private = HKDF(hashes.SHA256(), TUNNEL_KEY_BYTES, None, info).derive(kem.wire)
        return cls(private, X25519PrivateKey.from_private_bytes(private).public_key().public_bytes_raw())
