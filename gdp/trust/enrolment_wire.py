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
from typing import Annotated, Final, TypeAlias

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.cbor import Value, decode, encode
from gdp.crypto.certificates import Root
from gdp.crypto.kem import KEM_PUBLIC, KemPublicKey
from gdp.crypto.keys import SIGNATURE_BYTES, PublicKey, SigningKey
from gdp.crypto.schema import CERT, FLAG, OCTETS, STATEMENT, FieldSet, Keyed, many, mapped, octets, text, uint
from gdp.errors import DropReason, LocalError, StatementError
from gdp.trust.join_token import SERVERS_MAX

Message: TypeAlias = "Mapping[str, Value]"  # as it was received

VERSION: Final = 1
LENGTH_BYTES: Final = 4
NONCE_BYTES: Final = 32
INSTANCE_BYTES: Final = 16
STRANGER_MAX_BYTES: Final = 16 << 10  # a request of who has not proved to be a member
REQUEST_MAX_BYTES: Final = 64 << 10
RESPONSE_MAX_BYTES: Final = 4 << 20
MEMBERS_MAX: Final = 4  # nodes of one machine
DELEGATIONS_MAX: Final = 480  # of one machine
PAGE: Final = 64  # machines or mails in one response
_TRUSTS_MAX: Final = 64
_BORDERS_MAX: Final = 16
_DERIVED_BYTES: Final = 16
CLOCKS_APART_MAX_S: Final = 600.0  # below the tolerance of certificates' validity
TEXT: Final = text(4_096)
MEMBERS: Final = Keyed("members", many(CERT, MEMBERS_MAX, is_cut=False))
DELEGATIONS: Final = Keyed("delegations", many(OCTETS, DELEGATIONS_MAX, is_cut=False))
_ROOT: Final = mapped(OCTETS, Root.from_wire, Root.to_pem)


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
class Greeting(FieldSet):
    """The server's first message; ``nonce``: for the proofs of this connection."""

    version: Annotated[int, Keyed("v", uint())]
    root: Annotated[Root, Keyed("root", _ROOT)]
    nonce: Annotated[bytes, Keyed("nonce", octets(NONCE_BYTES))]
    unix_s: Annotated[int, Keyed("now", uint())]


@dataclass(frozen=True, slots=True)
class Application(FieldSet):
    """A machine's application for the membership of one node.

    Args:
        request: PKCS #10, PEM or DER.
        kem: the key to which secrets for the node are sealed.
        proof: that the node's key signs this, with this token.
    """

    request: Annotated[bytes, Keyed("request", OCTETS)]
    kem: Annotated[KemPublicKey, Keyed("kem", KEM_PUBLIC)]
    proof: Annotated[bytes, Keyed("proof", octets(SIGNATURE_BYTES))]

    def verify(self, key: PublicKey, identifier: bytes) -> None:
        """Return if the key signed this with the token of this id. Raises ``StatementError``: BAD_SIGNATURE."""
        key.verify(self.proof, _application_proof(identifier, self.request, self.kem))


@dataclass(frozen=True, slots=True)
class DomainNews(FieldSet):
    """What every member follows.

    Args:
        trusts: roots of other domains, PEM.
        borders: endpoint records.
        relays: ``host:port`` of the borders' relays.
        owner: public key, PEM.
    """

    root: Annotated[Root, Keyed("root", _ROOT)]
    trusts: Annotated[tuple[bytes, ...], Keyed("trusts", many(OCTETS, _TRUSTS_MAX, is_cut=False))]
    borders: Annotated[tuple[bytes, ...], Keyed("borders", many(STATEMENT, _BORDERS_MAX, is_cut=False))]
    relays: Annotated[tuple[str, ...], Keyed("relays", many(TEXT, SERVERS_MAX, is_cut=False))]
    owner: Annotated[bytes, Keyed("owner", OCTETS)]


@dataclass(frozen=True, slots=True)
class MemberProof(FieldSet):
    """Proof that a connection's client is a member; ``instance``: random for each start of its program."""

    certificate: Annotated[bytes, Keyed("certificate", CERT)]
    signature: Annotated[bytes, Keyed("signature", octets(SIGNATURE_BYTES))]
    instance: Annotated[bytes, Keyed("instance", octets(INSTANCE_BYTES))]


@dataclass(frozen=True, slots=True)
class InstallRequest(FieldSet):
    """Node descriptors of a machine, and the endpoint record of its switch."""

    cards: Annotated[tuple[bytes, ...], Keyed("cards", many(OCTETS, MEMBERS_MAX, is_cut=False))]
    record: Annotated[bytes, Keyed("record", STATEMENT)]


@dataclass(frozen=True, slots=True)
class ListedMachine(FieldSet):
    """Machine in the domain's directory; ``seen_unix_s``: when its agent was last connected, 0: never."""

    label: Annotated[str, Keyed("label", text(64))]
    role: Annotated[str, Keyed("role", text(16))]
    cards: Annotated[tuple[bytes, ...], Keyed("cards", many(OCTETS, MEMBERS_MAX, is_cut=False))]
    is_online: Annotated[bool, Keyed("online", FLAG)]
    seen_unix_s: Annotated[int, Keyed("seen", uint())]


@dataclass(frozen=True, slots=True)
class ListedMail(FieldSet):
    """Mail that waits for a member, under a number that rises."""

    number: Annotated[int, Keyed("n", uint())]
    mail: Annotated[bytes, Keyed("m", STATEMENT)]


def apply(identifier: bytes, key: SigningKey, request: bytes, kem: KemPublicKey) -> Application:
    """Return the application of a node with this key; ``identifier``: ``join_id`` of the token."""
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


def read_message(body: bytes) -> Message:
    """Return the map of a message. Raises ``StatementError``: MALFORMED."""
    value = decode(body, RESPONSE_MAX_BYTES)
    if not isinstance(value, dict):
        raise StatementError(DropReason.MALFORMED, "a map is expected")
    return value


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
