"""Decoders of network data: frames, statements, certificates, sealed fragments, control datagrams."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from typing import Final

from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.control.keepalive import open_keepalive, seal_keepalive
from gdp.control.presence import Presence
from gdp.control.rib_replication import Entry
from gdp.crypto import cbor
from gdp.crypto.certificates import Root, Unverified
from gdp.crypto.control_seal import ControlOpener, ControlSealer
from gdp.crypto.envelope import Opener
from gdp.crypto.introduction import Introduction
from gdp.crypto.kem import KemPublicKey
from gdp.crypto.keys import PublicKey
from gdp.crypto.statements import Fields, Statement, parse
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import read_request
from gdp.errors import EnvelopeError, FrameError, LocalError, RemoteError, StatementError
from gdp.frame import codec
from gdp.frame.kinds import Flag, Kind
from gdp.message import bundle
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.heartbeat import Heartbeat, StreamStart
from gdp.message.parity import Parity
from gdp.names import Name
from gdp.trust.adcert import AdCert
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.audit import BEGIN, AuditLine
from gdp.trust.bootstrap_ticket import (
    Application,
    EnrolmentResponse,
    Granted,
    Request,
    Seat,
    Ticket,
    request_head,
    seal_request,
)
from gdp.trust.delegation import Delegation
from gdp.trust.node_descriptor import NodeDescriptor
from gdp.trust.revocation import Revocation
from tests.fuzzing.decoder import Decoder
from tests.gdp.control.test_bodies import BODIES
from tests.gdp.message.sealed import INCARNATION, SECRET, SOURCE, TOPIC, seal
from tests.gdp.trust.world import CAMERA, DAY, LAB, NOW, ROBOT, SCHOOL, adcert, advertisement

__all__ = ["DECODERS"]

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
_READS: Final[dict[str, tuple[bytes, Callable[[Fields], object]]]] = {
    **{name.replace(",", "").replace(" ", "-"): (wire, read) for name, (wire, _, read) in BODIES.items()},
    "presence": (
        Presence(node=_A, incarnation=1, other=_A, question=7).to_wire(_NODE.name, _NODE.key, b"cert"),
        Presence.from_fields,
    ),
}
_STATEMENTS: Final[dict[str, tuple[bytes, Callable[[Statement], object]]]] = {
    "adcert": (adcert(), AdCert.from_statement),
    "claim": (advertisement(), UnverifiedAdvertisement.from_statement),
    "revocation": (Revocation.make(LAB.key, CAMERA, bytes(32), NOW), Revocation.from_statement),
}
_FRAMES: Final = seal(1, bytes(500))
_KEY: Final = bytes(32)
_HEADER: Final = codec.Header(Kind.KEEPALIVE, Flag.LAST, 64, 0, 16, 1, 0, 1, 1, bytes(32), bytes(_A))


def _body(wire: bytes) -> bytes:
    return cbor.encode(dict(parse(wire).body))


def _fields(data: bytes) -> Fields:
    value = cbor.decode(data)
    return Fields(value if isinstance(value, Mapping) else {})


def _of_fields(read: Callable[[Fields], object]) -> Callable[[bytes], object]:
    return lambda data: read(_fields(data))


def _of_statement(wire: bytes, read: Callable[[Statement], object]) -> Callable[[bytes], object]:
    statement = parse(wire)
    return lambda data: read(replace(statement, fields=_fields(data)))


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
        key=_KEY,
        epoch=1,
        kind=Kind.ACKNACK,
        source=SOURCE,
        incarnation=5,
        destination=TOPIC,
        topic=TOPIC,
        destination_incarnation=9,
        numbers=count(1),
    ).seal(b"body")


def _introduction() -> bytes:
    return Introduction.make(_NODE.subject, _NODE.key, 5, 1, _KEY)


_REPORT: Final = AckNack(AckNackFlag.NONE, 5, 1, (MissingRange(5, 1, 2),))
_STATUS: Final = Heartbeat(1, 5, 0, {bytes(32): StreamStart(1, 1, 1)}, b"description")
_TICKET: Final = Ticket(("tcp://a:1",), _NODE.kem.public, _KEY, (Seat("switch", _NODE.role, "a"),))
_APPLICATION: Final = Application(b"csr", _NODE.kem.public, bytes(64))
_GRANTED: Final = Granted(b"certificate", (b"delegation",))

DECODERS: Final = (
    Decoder("entry", Entry.from_bytes, (_ENTRY.to_bytes(),), (StatementError,), is_cbor=True),
    Decoder("frame", codec.decode, tuple(_FRAMES[:2]), (FrameError,)),
    Decoder("control", _control, (_control_seed(),), (FrameError,)),
    Decoder("cbor", cbor.decode, (cbor.encode({"a": [1, b"x", None, 1.5]}),), (StatementError,), is_cbor=True),
    Decoder("statement", parse, tuple(wire for wire, _ in _READS.values()), (StatementError,)),
    *(
        Decoder(name, _of_fields(read), (_body(wire),), (StatementError,), is_cbor=True)
        for name, (wire, read) in _READS.items()
    ),
    *(
        Decoder(name, _of_statement(wire, read), (_body(wire),), (StatementError,), is_cbor=True)
        for name, (wire, read) in _STATEMENTS.items()
    ),
    Decoder(
        "subject",
        _of_fields(lambda fields: Subject.from_fields(fields, CAMERA.name)),
        (cbor.encode(CAMERA.to_fields()),),
        (StatementError,),
        is_cbor=True,
    ),
    Decoder(
        "validity", _of_fields(Validity.from_fields), (cbor.encode(DAY.to_fields()),), (StatementError,), is_cbor=True
    ),
    Decoder("delegation", Delegation.from_wire, (cbor.encode({"format": ""}),), (StatementError,), is_cbor=True),
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
    Decoder("ticket", Ticket.from_json, (_TICKET.to_json(),), (LocalError,)),
    Decoder("enrol-head", request_head, (seal_request(_TICKET, [_APPLICATION], _KEY),), (StatementError,)),
    Decoder(
        "enrol-request",
        Request.from_wire,
        (Request(_KEY, (_APPLICATION,)).to_wire(),),
        (StatementError,),
        is_cbor=True,
    ),
    Decoder(
        "enrol-answer",
        EnrolmentResponse.from_wire,
        (EnrolmentResponse(b"root", (_GRANTED,)).to_wire(),),
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
