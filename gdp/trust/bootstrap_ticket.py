"""One-time enrolment: a machine with keys of its own requests memberships and delegations.

Sans-I/O except for the randomness that sealing draws. Source: HPKE (RFC 9180), HKDF (RFC 5869), HMAC (RFC 2104),
AES-256-GCM (NIST SP 800-38D), PKCS #10 (RFC 2986). The machine has a token of 32 random bytes and the responder's
public key, both from its ticket. On the wire::

    request   "GDPE" || version (1) || length of the rest (3) || id (16) || HPKE (body) || tag (32)
    response  0, refused; or 1 || length of the rest (3) || AES-256-GCM (body)

    id        HKDF-SHA256(token, "gdp-enrol-id-1"): finds the ticket, and reveals nothing of the token
    tag       HMAC-SHA256(HKDF-SHA256(token, "gdp-enrol-tag-1"), all bytes before the tag)
    HPKE      to the responder's key, info "gdp-enrol-body-1" || id
    response  key HKDF-SHA256(answer secret || token, "gdp-enrol-answer-1" || SHA-256(request)), nonce 0
    proof     signature by a member's key over "gdp-enrol-proof-1" || id || SHA-256(PKCS #10) || KEM key

The tag is verified before any step that costs more than a hash. The machine draws the answer secret for each request,
so a response key seals one response only. An attacker with the token alone can send requests, but can neither read nor
forge the response to another request. An attacker with neither learns nothing.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gdp.crypto.cbor import decode, encode
from gdp.crypto.certificates import Role
from gdp.crypto.fields import Fields
from gdp.crypto.kem import KEM_PUBLIC_BYTES, KemPrivateKey, KemPublicKey
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.errors import DropReason, LocalError, StatementError

__all__ = [
    "ANSWER_HEAD_BYTES",
    "ANSWER_MAX_BYTES",
    "ANSWER_SECRET_BYTES",
    "HEAD_BYTES",
    "ID_BYTES",
    "MEMBERS_MAX",
    "REFUSED",
    "REQUEST_MAX_BYTES",
    "TOKEN_BYTES",
    "Application",
    "EnrolmentResponse",
    "Granted",
    "Request",
    "Seat",
    "Ticket",
    "answer_bytes",
    "apply",
    "has_tag",
    "open_answer",
    "open_request",
    "request_head",
    "seal_answer",
    "seal_request",
    "token_id",
]

TOKEN_BYTES: Final = 32
ID_BYTES: Final = 16
ANSWER_SECRET_BYTES: Final = 32
MEMBERS_MAX: Final = 4
REQUEST_MAX_BYTES: Final = 16 << 10
ANSWER_MAX_BYTES: Final = 1 << 20
REFUSED: Final = b"\0"
_GRANTED: Final = b"\1"
_MAGIC: Final = b"GDPE\x01"
_LENGTH_BYTES: Final = 3
_BEGIN_BYTES: Final = len(_MAGIC) + _LENGTH_BYTES
HEAD_BYTES: Final = _BEGIN_BYTES + ID_BYTES
ANSWER_HEAD_BYTES: Final = 1 + _LENGTH_BYTES
_TAG_BYTES: Final = 32
_SIGNATURE_BYTES: Final = 64
_NONCE: Final = bytes(12)
_DELEGATIONS_MAX: Final = 480  # of each of the members: all fit the item limit of one decode


@dataclass(frozen=True, slots=True)
class Seat:
    """A planned member of a machine: the launcher's plan, which no request changes.

    Args:
        folder: with its keys, below the machine's folder.
    """

    folder: str
    role: Role
    label: str


@dataclass(frozen=True, slots=True)
class Ticket:
    """All that a machine receives about its enrolment.

    Args:
        addresses: of the responder, ``tcp:HOST:PORT`` or ``unix:PATH``, to be tried in this order.
        responder: the key that requests are sealed to.
        token: valid once, for minutes; the launcher stores its end.
    """

    addresses: tuple[str, ...]
    responder: KemPublicKey
    token: bytes = field(repr=False)
    seats: tuple[Seat, ...]

    def to_json(self) -> bytes:
        """Return the JSON that ``from_json`` reads."""
        document = {
            "addresses": self.addresses,
            "responder": base64.b64encode(self.responder.wire).decode(),
            "token": self.token.hex(),
            "seats": [{**asdict(each), "role": each.role.value} for each in self.seats],
        }
        return json.dumps(document, indent=1).encode()

    @classmethod
    def from_json(cls, data: bytes) -> Ticket:
        """Read a ticket. Raises ``LocalError``: not a ticket."""
        try:
            document = json.loads(data)
            responder = KemPublicKey.from_wire(base64.b64decode(document["responder"], validate=True))
            seats = tuple(Seat(each["folder"], Role(each["role"]), each["label"]) for each in document["seats"])
            token = bytes.fromhex(document["token"])
            addresses = tuple(map(str, document["addresses"]))
            ticket = cls(addresses, responder, token, seats)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, StatementError) as error:
            raise LocalError(f"not a ticket for an enrolment: {type(error).__name__}") from error
        if len(token) != TOKEN_BYTES or not 0 < len(seats) <= MEMBERS_MAX or not addresses:
            raise LocalError("not a ticket for an enrolment: it lacks a token, an address or a member")
        if any(not _is_folder(each.folder) for each in seats):
            raise LocalError("not a ticket for an enrolment: a folder outside of the machine's")
        return ticket


@dataclass(frozen=True, slots=True)
class Application:
    """A machine's application for one member.

    Args:
        request: PKCS #10, PEM or DER.
        kem: the key to which secrets for it are sealed.
        proof: that the member's key signs this, with this token.
    """

    request: bytes
    kem: KemPublicKey
    proof: bytes

    def verify(self, key: PublicKey, identifier: bytes) -> None:
        """Return if the key signed this with the token of this id. Raises ``StatementError``: BAD_SIGNATURE."""
        key.verify(self.proof, _proven(identifier, self.request, self.kem))


@dataclass(frozen=True, slots=True)
class Request:
    """An opened request."""

    answer_secret: bytes = field(repr=False)
    applications: tuple[Application, ...]

    def to_wire(self) -> bytes:
        """Return the bytes that ``from_wire`` reads."""
        asked = [{"request": each.request, "kem": each.kem.wire, "proof": each.proof} for each in self.applications]
        return encode({"answer": self.answer_secret, "members": asked})

    @classmethod
    def from_wire(cls, wire: bytes) -> Request:
        """Read the body of a request; a malformed one raises ``StatementError``."""
        fields = _map(wire, REQUEST_MAX_BYTES)
        asked = tuple(
            Application(
                each.bytes_("request"),
                KemPublicKey(each.bytes_("kem", KEM_PUBLIC_BYTES)),
                each.bytes_("proof", _SIGNATURE_BYTES),
            )
            for each in fields.maps("members", MEMBERS_MAX)
        )
        return cls(fields.bytes_("answer", ANSWER_SECRET_BYTES), asked)


@dataclass(frozen=True, slots=True)
class Granted:
    """What one member receives: its membership, and delegations as their files hold them."""

    member: bytes
    delegations: tuple[bytes, ...] = ()


@dataclass(frozen=True, slots=True)
class EnrolmentResponse:
    """What a machine receives.

    Args:
        root: the domain's, PEM.
        granted: one for each seat, in the order of the ticket.
    """

    root: bytes
    granted: tuple[Granted, ...]

    def to_wire(self) -> bytes:
        """Return the bytes that ``from_wire`` reads."""
        members = [{"member": each.member, "delegations": list(each.delegations)} for each in self.granted]
        return encode({"root": self.root, "granted": members})

    @classmethod
    def from_wire(cls, wire: bytes) -> EnrolmentResponse:
        """Read a response; a malformed one raises ``StatementError``."""
        fields = _map(wire, ANSWER_MAX_BYTES)
        granted = tuple(
            Granted(each.bytes_("member"), tuple(each.byte_strings("delegations", _DELEGATIONS_MAX)))
            for each in fields.maps("granted", MEMBERS_MAX)
        )
        return cls(fields.bytes_("root"), granted)


def token_id(token: bytes) -> bytes:
    """Return the id that finds a ticket: ``ID_BYTES``."""
    return _derived(token, b"gdp-enrol-id-1", ID_BYTES)


def apply(token: bytes, key: SigningKey, request: bytes, kem: KemPublicKey) -> Application:
    """Return the application of a member with this key."""
    return Application(request, kem, key.sign(_proven(token_id(token), request, kem)))


def seal_request(ticket: Ticket, applications: Sequence[Application], answer_secret: bytes) -> bytes:
    """Return the request that a machine sends.

    Args:
        answer_secret: ``ANSWER_SECRET_BYTES``, drawn for this request.

    Raises:
        StatementError: MALFORMED, the responder's key is invalid.
        LocalError: it is too long, or the library has no such KEM.
    """
    identifier = token_id(ticket.token)
    sealed = ticket.responder.seal(Request(answer_secret, tuple(applications)).to_wire(), _info(identifier))
    rest = ID_BYTES + len(sealed) + _TAG_BYTES
    if _BEGIN_BYTES + rest > REQUEST_MAX_BYTES:
        raise LocalError(f"a request for an enrolment has at most {REQUEST_MAX_BYTES} bytes")
    untagged = _MAGIC + rest.to_bytes(_LENGTH_BYTES, "big") + identifier + sealed
    return untagged + _tag(ticket.token, untagged)


def request_head(data: bytes) -> tuple[bytes, int] | None:
    """Return the id and the length of the whole request from its first bytes; None: too few of them yet.

    Raises:
        StatementError: MALFORMED, as early as the bytes show it.
    """
    if data[: len(_MAGIC)] != _MAGIC[: len(data)]:
        raise StatementError(DropReason.MALFORMED, "not a request for an enrolment")
    if len(data) < HEAD_BYTES:
        return None
    size = _BEGIN_BYTES + int.from_bytes(data[len(_MAGIC) : _BEGIN_BYTES], "big")
    if not HEAD_BYTES + _TAG_BYTES < size <= REQUEST_MAX_BYTES or len(data) > size:
        raise StatementError(DropReason.MALFORMED, "a request of a wrong length")
    return data[_BEGIN_BYTES:HEAD_BYTES], size


def has_tag(token: bytes, request: bytes) -> bool:
    """Return whether the sender of the request has the token; costs two hashes of it."""
    return hmac.compare_digest(_tag(token, request[:-_TAG_BYTES]), request[-_TAG_BYTES:])


def open_request(key: KemPrivateKey, request: bytes) -> Request:
    """Open a request whose tag is valid.

    Raises:
        StatementError: BAD_TAG or MALFORMED.
        LocalError: the library has no such KEM.
    """
    info = _info(request[_BEGIN_BYTES:HEAD_BYTES])
    return Request.from_wire(key.open(request[HEAD_BYTES:-_TAG_BYTES], info))


def seal_answer(token: bytes, request: bytes, answer_secret: bytes, answer: bytes) -> bytes:
    """Return the responder's response; of one request, always with the same content.

    Raises:
        LocalError: it is too long.
    """
    sealed = _answer_key(token, request, answer_secret).encrypt(_NONCE, answer, None)
    if len(sealed) > ANSWER_MAX_BYTES:
        raise LocalError(f"an enrolment comes to {len(sealed)} bytes, at most {ANSWER_MAX_BYTES} are allowed")
    return _GRANTED + len(sealed).to_bytes(_LENGTH_BYTES, "big") + sealed


def answer_bytes(head: bytes) -> int:
    """Return how many bytes of a response follow its head of ``ANSWER_HEAD_BYTES``.

    Raises:
        StatementError: MALFORMED, also a refusal.
    """
    size = int.from_bytes(head[1:], "big")
    if len(head) != ANSWER_HEAD_BYTES or head[:1] != _GRANTED or size > ANSWER_MAX_BYTES:
        raise StatementError(DropReason.MALFORMED, "no answer")
    return size


def open_answer(token: bytes, request: bytes, answer_secret: bytes, sealed: bytes) -> EnrolmentResponse:
    """Open the body of a response, without its head.

    Raises:
        StatementError: BAD_TAG, the responder did not make it, or MALFORMED.
    """
    try:
        wire = _answer_key(token, request, answer_secret).decrypt(_NONCE, sealed, None)
    except InvalidTag as error:
        raise StatementError(DropReason.BAD_TAG, "an answer that the responder did not make") from error
    return EnrolmentResponse.from_wire(wire)


def _answer_key(token: bytes, request: bytes, answer_secret: bytes) -> AESGCM:
    info = b"gdp-enrol-answer-1" + hashlib.sha256(request).digest()
    return AESGCM(_derived(answer_secret + token, info, 32))


def _tag(token: bytes, untagged: bytes) -> bytes:
    return hmac.digest(_derived(token, b"gdp-enrol-tag-1", 32), untagged, "sha256")


def _derived(secret: bytes, info: bytes, size: int) -> bytes:
    return HKDF(hashes.SHA256(), size, None, info).derive(secret)


def _info(identifier: bytes) -> bytes:
    return b"gdp-enrol-body-1" + identifier


def _proven(identifier: bytes, request: bytes, kem: KemPublicKey) -> bytes:
    return b"gdp-enrol-proof-1" + identifier + hashlib.sha256(request).digest() + kem.wire


def _map(wire: bytes, max_bytes: int) -> Fields:
    value = decode(wire, max_bytes)
    if not isinstance(value, dict):
        raise StatementError(DropReason.MALFORMED, "a map is expected")
    return Fields(value)


def _is_folder(text: object) -> bool:
    return isinstance(text, str) and 0 < len(text) <= 32 and text.isascii() and text.isalnum()
