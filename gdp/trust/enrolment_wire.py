"""Enrolment protocol: length-prefixed CBOR maps inside TLS 1.3.

Sans-I/O. Each message is 4 bytes of length and one map. The server speaks first::

    server    greeting  v (1), root (PEM), nonce (32), now (Unix seconds)
    joiner    join      id, nodes: [{request, kem, proof}], mac      -> members, borders, trusts, owner, label
    member    member    certificate, signature, instance             -> the connection is the member's from now on
              install   cards, record                                -> the border opens its tunnel to the member
              poll, renew, nodes, send, receive

The joiner verifies the greeting's root by the token's fingerprint, the TLS certificate by the root, and the clocks,
before it sends anything. A response has ``ok``; a refusal has ``code`` and ``error``, a sentence for people. A
machine of a cluster also receives ``delegations``. The key of each node signs its application::

    proof     "gdp-enrol-proof-1" || HKDF-SHA256(id, "gdp-enrol-id-1") (16) || SHA-256(PKCS #10) || KEM key
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.cbor import Value, decode, encode
from gdp.crypto.fields import Fields
from gdp.crypto.kem import KEM_PUBLIC_BYTES, KemPublicKey
from gdp.crypto.keys import SIGNATURE_BYTES, PublicKey, SigningKey
from gdp.errors import DropReason, LocalError, StatementError

__all__ = [
    "CLOCKS_APART_MAX_S",
    "DELEGATIONS_MAX",
    "INSTANCE_BYTES",
    "LENGTH_BYTES",
    "MEMBERS_MAX",
    "NONCE_BYTES",
    "REQUEST_MAX_BYTES",
    "RESPONSE_MAX_BYTES",
    "STRANGER_MAX_BYTES",
    "Application",
    "EnrolmentError",
    "Refusal",
    "UnreachableError",
    "apply",
    "encode_message",
    "message_bytes",
    "prove_member",
    "read_message",
    "verify_member_proof",
]

VERSION: Final = 1
LENGTH_BYTES: Final = 4
NONCE_BYTES: Final = 32
INSTANCE_BYTES: Final = 16
STRANGER_MAX_BYTES: Final = 16 << 10  # a request of who has not proved to be a member
REQUEST_MAX_BYTES: Final = 64 << 10
RESPONSE_MAX_BYTES: Final = 4 << 20
MEMBERS_MAX: Final = 4  # nodes of one machine
DELEGATIONS_MAX: Final = 480  # of one machine
_DERIVED_BYTES: Final = 16
CLOCKS_APART_MAX_S: Final = 600.0  # below the tolerance of certificates' validity


class Refusal(str, Enum):
    """Why a server refuses a request; the value is on the wire."""

    MALFORMED = "malformed"
    UNKNOWN_TOKEN = "unknown-token"
    WRONG_PROOF = "wrong-proof"
    USED = "used"
    EXPIRED = "expired"
    LABEL_TAKEN = "label-taken"
    IDENTITY_TAKEN = "identity-taken"
    WRONG_NODES = "wrong-nodes"
    NO_MEMBER = "no-member"
    TWO_MACHINES = "two-machines"
    MAILBOX_FULL = "mailbox-full"
    UNAVAILABLE = "unavailable"


class EnrolmentError(LocalError):
    """The server refused, or is not the token's; the text is for people.

    Args:
        about: label of the machine, for the server's audit log; empty: unknown.
    """

    def __init__(self, code: Refusal | None, text: str, about: str = "") -> None:
        super().__init__(text)
        self.code = code
        self.about = about


class UnreachableError(EnrolmentError):
    """No server could be reached, or the connection broke: the caller may try again."""

    def __init__(self, text: str) -> None:
        super().__init__(None, text)


@dataclass(frozen=True, slots=True)
class Application:
    """A machine's application for the membership of one node.

    Args:
        request: PKCS #10, PEM or DER.
        kem: the key to which secrets for the node are sealed.
        proof: that the node's key signs this, with this token.
    """

    request: bytes
    kem: KemPublicKey
    proof: bytes

    @classmethod
    def from_fields(cls, fields: Fields) -> Application:
        """Read an application; a malformed one raises ``StatementError``."""
        kem = KemPublicKey(fields.bytes_("kem", KEM_PUBLIC_BYTES))
        return cls(fields.bytes_("request"), kem, fields.bytes_("proof", SIGNATURE_BYTES))

    def to_fields(self) -> dict[str, Value]:
        """Return the map that ``from_fields`` reads."""
        return {"request": self.request, "kem": self.kem.wire, "proof": self.proof}

    def verify(self, key: PublicKey, identifier: bytes) -> None:
        """Return if the key signed this with the token of this id. Raises ``StatementError``: BAD_SIGNATURE."""
        key.verify(self.proof, _application_proof(identifier, self.request, self.kem))


def apply(identifier: bytes, key: SigningKey, request: bytes, kem: KemPublicKey) -> Application:
    """Return the application of a node with this key.

    Args:
        identifier: ``join_id`` of the token.
    """
    return Application(request, kem, key.sign(_application_proof(identifier, request, kem)))


def encode_message(fields: Mapping[str, object]) -> bytes:
    """Return a message with its length. Raises ``LocalError``: it cannot be encoded."""
    body = encode(dict(fields))
    return len(body).to_bytes(LENGTH_BYTES, "big") + body


def message_bytes(head: bytes, maximum: int) -> int:
    """Return the length of the message after its first ``LENGTH_BYTES``. Raises ``StatementError``: too long."""
    size = int.from_bytes(head, "big")
    if not 0 < size <= maximum:
        raise StatementError(DropReason.TOO_BIG, f"a message of {size} bytes; at most {maximum} are read")
    return size


def read_message(body: bytes) -> Fields:
    """Return the map of a message. Raises ``StatementError``: MALFORMED."""
    value = decode(body, RESPONSE_MAX_BYTES)
    if not isinstance(value, dict):
        raise StatementError(DropReason.MALFORMED, "a map is expected")
    return Fields(value)


def prove_member(key: SigningKey, binding: bytes, nonce: bytes, instance: bytes) -> bytes:
    """Return the signature by which a member shows, on one TLS connection, that it has its key."""
    return key.sign(_member_proof(binding, nonce, instance))


def verify_member_proof(key: PublicKey, signature: bytes, binding: bytes, nonce: bytes, instance: bytes) -> None:
    """Return if the member signed this connection. Raises ``StatementError``: BAD_SIGNATURE."""
    key.verify(signature, _member_proof(binding, nonce, instance))


def _member_proof(binding: bytes, nonce: bytes, instance: bytes) -> bytes:
    return b"gdp-enrolment-member-1" + hashlib.sha256(binding + nonce + instance).digest()


def _application_proof(identifier: bytes, request: bytes, kem: KemPublicKey) -> bytes:
    derived = HKDF(hashes.SHA256(), _DERIVED_BYTES, None, b"gdp-enrol-id-1").derive(identifier)
    return b"gdp-enrol-proof-1" + derived + hashlib.sha256(request).digest() + kem.wire
