"""Signed statements: CBOR maps with a type and a signer, in one canonical form.

Sans-I/O. Source: COSE_Sign1, RFC 9052, section 4.2, with ES256 (RFC 9053). The form is fixed, so that reading it needs
no general COSE parser::

    tag 18 [ h'{1: -7 (ES256), 4: signer's name (32)}', {}, h'payload', h'r || s (64)' ]
    payload = deterministic CBOR map, text keys, "t": the type

A parsed statement is unverified: ``verify`` proves its signer.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from gdp.crypto.cbor import Value, decode, encode
from gdp.crypto.keys import SIGNATURE_BYTES, PublicKey, SigningKey
from gdp.errors import DropReason, LocalError, StatementError
from gdp.intervals import DAY_S
from gdp.limits import CONTROL_MAX_BYTES
from gdp.names import NAME_BYTES, Name


class StatementType(str, Enum):
    """Registry of statement types; the value stands in the payload under ``t``."""

    ADVERTISE = "advertise"  # a node's advertisement of a name, to its switch, and on to RIBs
    WITHDRAW = "withdraw"
    QUERY = "query"
    ANSWER = "answer"
    JOIN = "join"
    JOIN_REFRESH = "join-refresh"  # to a neighbour: these joins stand; or back: these of them are not known
    PACE = "pace"  # a reader to its switch: which messages of a publisher its branch gets
    LINK_STATE = "link-state"
    HELLO = "hello"
    ADCERT = "adcert"  # owner to node: the node has these rights on the name
    RTCERT = "rtcert"  # node to switch: the switch may attract its traffic
    CARD = "card"  # a node's descriptor, for owners
    GRANT = "grant"  # owner to node: a topic secret, sealed
    RELAY = "relay"  # an advertisement that a switch or a RIB relays
    REVOKE = "revoke"
    ADVERTISE_ACK = "advertise-ack"
    PRESENCE = "presence"  # RIB to switch and back: is the older of two nodes with one identity still there?
    SYNC = "sync"  # between neighbours, or RIBs of one domain: what each has of a set, and what the other lacks
    OPEN = "open"  # switch or RIB to a RIB: a channel
    ACCEPT = "accept"
    ENDPOINTS = "endpoints"  # of a switch: where it can be reached across IP networks
    DIAGNOSTIC_REQUEST = "diagnostic-request"  # between members: measure a path, or tell about a name
    DIAGNOSTIC_REPLY = "diagnostic-reply"
    MAIL = "mail"  # between members, kept by the enrolment server


_TYPES: Final[dict[Value, StatementType]] = {member.value: member for member in StatementType}

# 18(  [4 items,  bstr(38)  {1: -7, 4: bstr(32)  and then the name
_HEAD: Final = b"\xd2\x84" + b"\x58\x26" + b"\xa2\x01\x26\x04\x58\x20"
_UNPROTECTED: Final = b"\xa0"
_SIGNATURE_HEAD: Final = b"\x58\x40"
_SIGNER_AT: Final = len(_HEAD)
_PROTECTED_END: Final = _SIGNER_AT + NAME_BYTES
_PAYLOAD_AT: Final = _PROTECTED_END + 1  # after the empty unprotected map
_TAIL_BYTES: Final = 2 + SIGNATURE_BYTES
_SIGNED_HEAD: Final = b"\x84\x6aSignature1"  # Sig_structure; RFC 9052, section 4.4
_NO_EXTERNAL_DATA: Final = b"\x40"


@dataclass(frozen=True, slots=True, kw_only=True)
class Statement:
    """A parsed statement, UNVERIFIED until ``verify`` returns.

    Args:
        signer: the name of the alleged signer; the verifier must know that name's key.
        signature: r || s.
        signed_bytes: the Sig_structure.
    """

    type: StatementType
    signer: Name
    fields: Mapping[str, Value]
    signature: bytes
    signed_bytes: bytes
    wire: bytes

    @property
    def fingerprint(self) -> bytes:
        """Return SHA-256 of the signed bytes: the same for every valid signature over them."""
        return hashlib.sha256(self.signed_bytes).digest()

    def expect(self, expected: StatementType) -> Mapping[str, Value]:
        """Return the body if the statement is of this type. Raises ``StatementError``: MALFORMED."""
        if self.type is not expected:
            raise StatementError(DropReason.MALFORMED, f"{self.type.value} where {expected.value} was due")
        return self.fields

    def verify(self, public: PublicKey) -> None:
        """Return if ``public`` signed it. The caller must know that the key belongs to ``signer``.

        Raises:
            StatementError: BAD_SIGNATURE.
        """
        public.verify(self.signature, self.signed_bytes)


def sign(type_: StatementType, body: Mapping[str, object], signer: Name, key: SigningKey) -> bytes:
    """Return the wire form of a statement; ``body`` must not use the key ``t``.

    Raises:
        LocalError: a value that CBOR cannot carry, a key ``t``, or more than ``CONTROL_MAX_BYTES``.
    """
    if "t" in body:
        raise LocalError("'t' is the statement's type")
    encoded = encode({**body, "t": type_.value})
    _check_size(len(encoded))  # before its length must fit into two bytes
    payload = _byte_string(encoded)
    protected = _HEAD[2:] + signer
    signature = key.sign(_SIGNED_HEAD + protected + _NO_EXTERNAL_DATA + payload)
    wire = _wire(signer, payload, signature)
    _check_size(len(wire))
    return wire


def assemble(type_: StatementType, body: Mapping[str, object], signer: Name, signature: bytes) -> bytes:
    """Return the wire form of a statement whose signature (64 bytes) is known already."""
    return _wire(signer, _byte_string(encode({**body, "t": type_.value})), signature)


def parse(wire: bytes) -> Statement:
    """Parse a statement without verifying it; costs 5 to 20 us.

    Raises:
        StatementError: MALFORMED, for any other bytes; never another exception.
    """
    payload_end = len(wire) - _TAIL_BYTES
    if (
        len(wire) > CONTROL_MAX_BYTES
        or payload_end <= _PAYLOAD_AT
        or not wire.startswith(_HEAD)
        or wire[_PROTECTED_END:_PAYLOAD_AT] != _UNPROTECTED
        or wire[payload_end : payload_end + 2] != _SIGNATURE_HEAD
    ):
        raise StatementError(DropReason.MALFORMED, "not a COSE_Sign1 of the form used here")
    boxed = wire[_PAYLOAD_AT:payload_end]
    body = decode(_unboxed(boxed))
    if not isinstance(body, dict):
        raise StatementError(DropReason.MALFORMED, "the payload is not a map")
    kind = body.pop("t", None)
    type_ = _TYPES.get(kind) if isinstance(kind, str) else None
    if type_ is None:
        raise StatementError(DropReason.MALFORMED, "no type, or an unknown one")
    return Statement(
        type=type_,
        signer=Name(wire[_SIGNER_AT:_PROTECTED_END]),
        fields=body,
        signature=wire[payload_end + 2 :],
        signed_bytes=_SIGNED_HEAD + wire[2:_PROTECTED_END] + _NO_EXTERNAL_DATA + boxed,
        wire=wire,
    )


def check_sequence(sequence: int, unix_s: float) -> None:
    """Return if a sequence number leaves values for newer ones.

    Sequence numbers are milliseconds of wall clocks, which may be wrong. A number of the far future would be the last
    that its owner, or a node that has to exceed it, can use.

    Raises:
        StatementError: MALFORMED.
    """
    if sequence > (unix_s + 366 * DAY_S) * 1_000:
        raise StatementError(DropReason.MALFORMED, "a sequence number of the far future")


def _check_size(size: int) -> None:
    if size > CONTROL_MAX_BYTES:
        raise LocalError(f"a statement of {size} bytes; at most {CONTROL_MAX_BYTES} are allowed")


def _wire(signer: bytes, boxed: bytes, signature: bytes) -> bytes:
    return _HEAD + signer + _UNPROTECTED + boxed + _SIGNATURE_HEAD + signature


def _byte_string(payload: bytes) -> bytes:
    size = len(payload)
    if size < 24:
        return bytes((0x40 | size,)) + payload
    return (b"\x58" + size.to_bytes(1, "big") if size < 256 else b"\x59" + size.to_bytes(2, "big")) + payload


def _unboxed(boxed: bytes) -> bytes:
    """Return the content of a deterministic byte string; ``boxed`` is at most ``CONTROL_MAX_BYTES``."""
    if boxed[0] == 0x58 and len(boxed) >= 2 + 24 and boxed[1] == len(boxed) - 2:
        return boxed[2:]
    if boxed[0] == 0x59 and len(boxed) >= 3 + 256 and int.from_bytes(boxed[1:3], "big") == len(boxed) - 3:
        return boxed[3:]
    if 0x40 <= boxed[0] < 0x58 and boxed[0] - 0x40 == len(boxed) - 1:
        return boxed[1:]
    raise StatementError(DropReason.MALFORMED, "a payload of another length than it says")
