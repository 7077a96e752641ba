"""Decoders of network data: frames, statements, certificates, sealed fragments, control datagrams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import count
from typing import Final, TypeVar

from gdp.control.endpoints import EndpointRecord
from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.control.keepalive import open_keepalive, seal_keepalive
from gdp.control.presence import Presence
from gdp.control.rib_replication import Entry
from gdp.crypto import cbor
from gdp.crypto.cbor import Value
from gdp.crypto.certificates import Root, Unverified
from gdp.crypto.control_seal import ControlContext, ControlOpener, ControlSealer
from gdp.crypto.envelope import Opener
from gdp.crypto.introduction import Introduction
from gdp.crypto.kem import KemPublicKey
from gdp.crypto.keys import PublicKey
from gdp.crypto.schema import Keyed, Spread, inner, many
from gdp.crypto.statements import parse
from gdp.crypto.subject import NAMED_SUBJECT
from gdp.crypto.validity import VALIDITY
from gdp.crypto.x509_profile import read_request
from gdp.errors import EnvelopeError, FrameError, LocalError, RemoteError, StatementError
from gdp.frame import codec
from gdp.frame.codec import Flag, Kind
from gdp.message import bundle
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.heartbeat import Heartbeat, StreamStart
from gdp.message.parity import Parity
from gdp.names import Name
from gdp.trust.audit import BEGIN, AuditLine
from gdp.trust.enrolment_wire import Application, read_message
from gdp.trust.join_token import JoinRole, JoinToken
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.revocation import Revocation
from tests.fuzzing.bodies import decoders
from tests.fuzzing.decoder import Decoder
from tests.gdp.control.test_bodies import BODIES
from tests.gdp.message.sealed import INCARNATION, SECRET, SOURCE, TOPIC, seal
from tests.gdp.trust.world import CAMERA, DAY, LAB, NOW, ROBOT, SCHOOL, adcert, advertisement

__all__ = ["DECODERS"]

_T = TypeVar("_T")

_A: Final = Name(b"a" * 32)
_NODE: Final = ROBOT
_HEIR: Final = SCHOOL.succeed(LAB.key, DAY, NOW)
_AUDIT: Final = AuditLine(
    seq=1, at_unix_s=NOW, action="accepted", what="name", who="ab", about="cd", reason="", count=1, previous=BEGIN
).to_line()
_ENTRY: Final = Entry(
    statement=b"claim",
    membership=b"cert",
    sender=_A,
    domain=_A,
    via=_A,
    transit=(_A,),
    lease_s=9.0,
    is_from_upstream=False,
)
_MADE: Final = (Presence(node=_A, incarnation=1, other=_A, question=7),)
_STATEMENTS: Final = (
    *(wire for wire, _, _ in BODIES.values()),
    *(each.to_wire(_NODE.name, _NODE.key, b"cert") for each in _MADE),
    adcert(),
    advertisement(),
    NodeDescriptor.make(_NODE),
    EndpointRecord.make(_NODE, (bytes(32),), (), sequence=1, until_unix_s=NOW).wire,
)
_REVOCATION: Final = parse(Revocation.make(LAB.key, CAMERA, bytes(32), NOW))
_FRAMES: Final = seal(1, bytes(500))
_KEY: Final = bytes(32)
_HEADER: Final = codec.Header(Kind.KEEPALIVE, Flag.LAST, 64, 0, 16, 1, 0, 1, 1, bytes(32), bytes(_A))


def _fields(data: bytes) -> Mapping[str, Value]:
    value = cbor.decode(data)
    return value if isinstance(value, Mapping) else {}


def _spread(name: str, spread: Spread[_T], value: _T) -> Decoder:
    seeds = (cbor.encode(spread.to_fields(value)),)
    return Decoder(name, lambda data: spread.read(_fields(data)), seeds, (StatementError,), is_cbor=True)


def _control(data: bytes) -> object:
    """Take frames, each after two bytes of its length."""
    reassembler, at = ControlReassembler(), 0
    got: list[bytes | None] = []
    while at + 2 <= len(data):
        end = at + 2 + int.from_bytes(data[at : at + 2], "big")
        frame = data[at + 2 : end]
        at = end
        got.append(reassembler.add(codec.decode(frame), frame, float(len(got))))
    return got


def _control_seed() -> bytes:
    frames = ControlFragmenter(_NODE.name, 7).split(Kind.HELLO, bytes(3_000), 1_500)
    return b"".join(len(frame).to_bytes(2, "big") + frame for frame in frames)


def _envelope(data: bytes) -> object:
    return Opener(SECRET, Kind.DATA, SOURCE, INCARNATION, TOPIC).open(codec.decode(data), data)


def _note(data: bytes) -> object:
    return ControlOpener(_KEY, TOPIC, 9).open(codec.decode(data), data)


def _note_seed() -> bytes:
    return ControlSealer(
        key=_KEY, epoch=1, context=ControlContext(Kind.ACKNACK, SOURCE, 5, TOPIC, 9, TOPIC), numbers=count(1)
    ).seal(b"body")


def _introduction() -> bytes:
    return Introduction.make(_NODE.subject, _NODE.key, 5, 1, _KEY)


_REPORT: Final = AckNack(AckNackFlag.NONE, 5, 1, (MissingRange(5, 1, 2),))
_STATUS: Final = Heartbeat(1, 5, 0, {bytes(32): StreamStart(1, 1, 1)}, b"description")
_TOKEN: Final = JoinToken(
    root=_KEY, secret=bytes(16), role=JoinRole.MACHINE, expires_unix_s=NOW, servers=("a:1", "unix:/run/a")
)
_APPLICATION: Final = Application(b"csr", _NODE.kem.public, bytes(64))

DECODERS: Final = (
    Decoder("frame", codec.decode, tuple(_FRAMES[:2]), (FrameError,)),
    Decoder("control", _control, (_control_seed(),), (FrameError,)),
    Decoder("cbor", cbor.decode, (cbor.encode({"a": [1, b"x", None, 1.5]}),), (StatementError,), is_cbor=True),
    Decoder("statement", parse, _STATEMENTS, (StatementError,)),
    *decoders("gdp", _STATEMENTS),
    Decoder(
        "revocation",
        lambda data: Revocation.from_statement(replace(_REVOCATION, fields=_fields(data))),
        (cbor.encode(dict(_REVOCATION.fields)),),
        (StatementError,),
        is_cbor=True,
    ),
    _spread("subject", NAMED_SUBJECT, CAMERA),
    _spread("validity", VALIDITY, DAY),
    Decoder("card", NodeDescriptor.from_wire, (NodeDescriptor.make(_NODE),), (StatementError,)),
    Decoder("root", Root.from_wire, (SCHOOL.root.wire, _HEIR.root.to_pem()), (StatementError,)),
    Decoder("audit-line", AuditLine.from_line, (_AUDIT,), (LocalError,)),
    Decoder("membership", Unverified.from_wire, (_NODE.membership,), (StatementError,)),
    Decoder("request", read_request, (_NODE.membership,), (StatementError,)),
    Decoder("kem-key", KemPublicKey.from_wire, (_NODE.kem.public.wire,), (StatementError, LocalError)),
    Decoder("public-key", PublicKey.from_compressed, (LAB.key.public.compressed,), (StatementError,)),
    Decoder("public-pem", PublicKey.from_pem, (LAB.key.public.to_pem(),), (LocalError, StatementError)),
    Decoder("envelope", _envelope, tuple(_FRAMES), (RemoteError,)),
    Decoder("note", _note, (_note_seed(),), (RemoteError,)),
    Decoder(
        "introduction",
        lambda data: Introduction.from_wire(data, _NODE.name, 5),
        (_introduction(),),
        (StatementError,),
    ),
    Decoder(
        "keepalive",
        lambda data: open_keepalive(_KEY, data),
        (seal_keepalive(_KEY, _HEADER, 0, 3, bytes(8)),),
        (FrameError,),
    ),
    Decoder(
        "join-token",
        lambda data: JoinToken.from_text(data.decode("latin-1")),
        (_TOKEN.to_text().encode(),),
        (LocalError,),
    ),
    Decoder(
        "join-request",
        lambda data: Keyed("nodes", many(inner(Application), 4)).read(read_message(data)),
        (cbor.encode({"op": "join", "nodes": [_APPLICATION.to_fields()]}),),
        (StatementError,),
        is_cbor=True,
    ),
    Decoder("report", AckNack.from_wire, (_REPORT.to_wire(),), (FrameError,)),
    Decoder("status", Heartbeat.from_wire, (_STATUS.to_wire(),), (FrameError,)),
    Decoder("parity", Parity.from_wire, (Parity(3, 1, 2, bytes(40)).to_wire(),), (EnvelopeError,)),
    Decoder("bundle", bundle.unpack, (bundle.pack([b"a", b"bc"]),), (FrameError,)),
    Decoder(
        "name", lambda data: Name.from_text(data.decode("latin-1")), (_A.to_text().encode(),), (LocalError, ValueError)
    ),
)
