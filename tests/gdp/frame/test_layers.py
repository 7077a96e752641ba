"""Scapy layers of GDP, compared with the codec on generated headers."""

from __future__ import annotations

import struct
from typing import Any

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.l2 import Ether
from scapy.packet import Packet, Padding, Raw

from gdp.errors import DropReason, FrameError, LocalError
from gdp.frame import codec
from gdp.frame.codec import (
    DESTINATION_AT,
    ETHERTYPE,
    HEADER_BYTES,
    HOPS_AT,
    KIND_AT,
    SECOND_PATH,
    SOURCE_AT,
    Header,
    Kind,
    decode,
    encode,
    ethernet,
)
from gdp.frame.layers import GDP, Keepalive, Statement, layout
from gdp.limits import PARTS_MAX
from tests.gdp.frame.frames import frames

ETHER = ethernet(b"\x02\0\0\0\0\x01", b"\x02\0\0\0\0\x02")
ALICE, BOB = b"a" * 32, b"b" * 32


def read(layer: GDP) -> Header:
    """Return the fields of the Scapy layer in the codec's form."""
    values = (getattr(layer, name) for name in Header._fields)
    return Header._make(value if isinstance(value, bytes) else int(value) for value in values)


def shown(packet: Packet) -> str:
    return str(packet.show(dump=True))


def statement(body: dict[str, object], signature: bytes = b"s" * 64) -> bytes:
    protected = cbor2.dumps({1: -7, 4: BOB})
    return cbor2.dumps(cbor2.CBORTag(18, [protected, {}, cbor2.dumps(body), signature]))


# equality of the Scapy layer and the codec


@given(frames())
def test_the_layer_builds_what_the_codec_encodes(made: tuple[Header, bytes, bytes]) -> None:
    header, payload, _ = made
    fields = header._asdict()
    del fields["length"]
    assert bytes(GDP(**fields) / Raw(payload)) == encode(header) + payload


@given(frames())
def test_the_layer_reads_what_the_codec_decodes(made: tuple[Header, bytes, bytes]) -> None:
    header, payload, padding = made
    wire = encode(header) + payload + padding
    layer = Ether(ETHER + wire)[GDP]
    assert read(layer) == decode(wire)
    assert bytes(layer.payload)[: len(payload)] == payload


@given(frames())
def test_reading_and_building_again_changes_nothing(made: tuple[Header, bytes, bytes]) -> None:
    header, payload, padding = made
    wire = ETHER + encode(header) + payload + padding
    packet = Ether(wire)
    assert bytes(packet) == wire
    packet[GDP].hops_left = (header.hops_left + 1) % 256
    packet[Ether].dst = "02:00:00:00:00:09"
    after = bytes(packet)
    assert after[14 + HOPS_AT] == (header.hops_left + 1) % 256
    assert after[6 : 14 + HOPS_AT] == wire[6 : 14 + HOPS_AT]
    assert after[15 + HOPS_AT :] == wire[15 + HOPS_AT :]


@given(frames())
def test_padding_is_not_payload(made: tuple[Header, bytes, bytes]) -> None:
    header, payload, padding = made
    packet = Ether(ETHER + encode(header) + payload + padding)
    found = packet.getlayer(Padding)
    assert (bytes(found) if found is not None else b"") == padding


@given(frames(), st.data())
def test_both_call_the_same_frames_truncated(made: tuple[Header, bytes, bytes], data: st.DataObject) -> None:
    header, payload, _ = made
    wire = encode(header) + payload
    cut = wire[: data.draw(st.integers(0, len(wire)))]
    layer = Ether(ETHER + cut).getlayer(GDP)
    complete = layer is not None and len(layer.payload) >= layer.length
    if complete:
        assert decode(cut) == header
        return
    with pytest.raises(FrameError) as caught:
        decode(cut)
    assert caught.value.reason is DropReason.TRUNCATED


@given(frames(), st.integers(0, 255))
def test_both_see_another_version(made: tuple[Header, bytes, bytes], version: int) -> None:
    header, payload, _ = made
    wire = bytes([version]) + encode(header)[1:] + payload
    assert Ether(ETHER + wire)[GDP].version == version
    if version != 1:
        with pytest.raises(FrameError) as caught:
            decode(wire)
        assert caught.value.reason is DropReason.BAD_VERSION


@given(frames(), st.integers(0, 255))
def test_both_read_unknown_kinds(made: tuple[Header, bytes, bytes], kind: int) -> None:
    header, payload, _ = made
    wire = encode(header._replace(kind=kind)) + payload
    assert Ether(ETHER + wire)[GDP].kind == decode(wire).kind == kind


@given(st.binary(max_size=250))
def test_arbitrary_bytes_are_shown_and_built_again(data: bytes) -> None:
    packet = Ether(ETHER + data)
    assert packet.show(dump=True)
    assert packet.summary()
    assert bytes(packet) == ETHER + data


def test_the_codec_knows_where_the_layer_puts_its_fields() -> None:
    places = layout()
    assert sum(size for _, size in places.values()) == HEADER_BYTES
    assert (places["kind"][0], places["hops_left"][0]) == (KIND_AT, HOPS_AT)
    assert (places["destination"], places["source"]) == ((DESTINATION_AT, 32), (SOURCE_AT, 32))
    assert set(places) == {"version", *Header._fields}


def test_the_codec_has_the_layout_of_the_layer() -> None:
    assert codec.layout() == layout()


def test_the_defaults_make_a_frame_that_decodes() -> None:
    header = decode(bytes(GDP()))
    assert (header.kind, header.part, header.parts, header.length) == (Kind.DATA, 0, 1, 0)
    assert header.parts <= PARTS_MAX


# texts for people


def test_ethernet_above_a_frame_gets_the_ethertype() -> None:
    packet: Packet = Ether() / GDP()
    assert packet.type == ETHERTYPE


def test_kinds_and_flags_have_words() -> None:
    packet = GDP(kind="echo-request", flags="last+reliable")
    assert (packet.kind, int(packet.flags)) == (Kind.ECHO_REQUEST, 3)
    assert "echo-request" in shown(packet)
    assert "last+reliable" in shown(packet)


def test_a_name_may_be_given_as_hex_digits() -> None:
    assert GDP(destination="ab" * 32).destination == b"\xab" * 32


@pytest.mark.parametrize("wrong", [b"short", "ab", 7])
def test_a_wrong_name_is_our_own_fault(wrong: object) -> None:
    with pytest.raises(LocalError):
        GDP(destination=wrong)


def test_the_summary_tells_the_way_and_the_part() -> None:
    packet = GDP(kind=Kind.DATA, source=ALICE, destination=BOB, number=5, part=1, parts=3)
    assert packet.mysummary() == "GDP data 616…161 > 626…262 #5 2/3 hops 64"


def test_a_second_copy_is_shown_with_its_hops() -> None:
    packet = GDP(kind=Kind.DATA, source=ALICE, destination=BOB, number=5, hops_left=SECOND_PATH | 63)
    assert packet.mysummary().endswith("hops 63 (second path)")


# queries and responses


@pytest.mark.parametrize(
    ("question", "answer"), [(Kind.ECHO_REQUEST, Kind.ECHO_REPLY), (Kind.RIB_REQUEST, Kind.RIB_ANSWER)]
)
def test_an_answer_belongs_to_its_question(question: Kind, answer: Kind) -> None:
    asked: Packet = Ether() / GDP(kind=question, number=9, source=ALICE, destination=BOB)
    answered: Packet = Ether() / GDP(kind=answer, number=9, source=BOB, destination=ALICE)
    assert answered.answers(asked)
    assert answered.hashret() == asked.hashret()


@pytest.mark.parametrize(
    "changed",
    [{"number": 10}, {"kind": Kind.RIB_ANSWER}, {"kind": Kind.ECHO_REQUEST}, {"source": ALICE}, {"destination": BOB}],
)
def test_anything_else_answers_nothing(changed: dict[str, Any]) -> None:
    asked = GDP(kind=Kind.ECHO_REQUEST, number=9, source=ALICE, destination=BOB)
    fields = {"kind": Kind.ECHO_REPLY, "number": 9, "source": BOB, "destination": ALICE}
    assert not GDP(**{**fields, **changed}).answers(asked)


# statements


def test_a_statement_is_shown_in_words() -> None:
    body: dict[str, object] = {"t": "hello", "name": ALICE, "inside": cbor2.dumps({"cost": 10})}
    packet = Ether(bytes(Ether() / GDP(kind=Kind.HELLO) / Raw(statement(body))))
    text = shown(packet)
    assert f'{{"t": "hello", "name": h\'{ALICE.hex()}\', "inside": <<{{"cost": 10}}>>}}' in text
    assert f"{{1: -7, 4: h'{BOB.hex()}'}}" in text
    assert packet[Statement].signature == b"s" * 64


NEIGHBOURS = [kind for kind in Kind if kind >= 0x80 and kind not in (Kind.KEEPALIVE, Kind.COOKIE)]
CARRIERS = [*NEIGHBOURS, Kind.RIB_REQUEST, Kind.RIB_ANSWER]


@pytest.mark.parametrize("kind", CARRIERS)
def test_every_kind_that_carries_a_statement_shows_it(kind: Kind) -> None:
    assert Ether(bytes(Ether() / GDP(kind=kind) / Raw(statement({"t": "x"})))).haslayer(Statement)


def test_a_keepalive_is_shown_field_by_field() -> None:
    payload = b"\x05\x03" + b"d" * 8 + struct.pack(">QQIB", 9, 8, 70_000, 7) + b"t" * 16
    packet = Ether(bytes(Ether() / GDP(kind=Kind.KEEPALIVE) / Raw(payload)))
    shown = packet[Keepalive]
    said = str(shown.flags), shown.multiplier, shown.digest, shown.tag
    assert said == ("poll+heard", 3, b"d" * 8, b"t" * 16)
    assert (shown.sent, shown.echo, shown.held_us, shown.loss) == (9, 8, 70_000, 7)


def test_a_statement_can_be_built() -> None:
    wire = statement({"t": "hello", "long": b"x" * 300})
    assert bytes(Statement(wire)) == wire
    protected, body = cbor2.dumps({1: -7, 4: BOB}), cbor2.dumps({"t": "hello", "long": b"x" * 300})
    assert bytes(Statement(protected=protected, body=body, signature=b"s" * 64)) == wire


@pytest.mark.parametrize(
    "payload",
    [
        statement({"t": "hello"})[:-1],
        statement({"t": "hello"}) + b"\0",
        b"\xd2\x84" + b"\x81" * 1_000,
        b"\xd2\x84\x40\xa0\x5b\xff\xff\xff\xff\xff\xff\xff\xff",
        cbor2.dumps(cbor2.CBORTag(18, [b"", {1: 2}, b"", b""])),
        cbor2.dumps(cbor2.CBORTag(18, [b"", {}, "text", b""])),
        cbor2.dumps({"t": "hello"}),
    ],
)
def test_a_malformed_statement_is_shown_raw(payload: bytes) -> None:
    packet = Ether(bytes(Ether() / GDP(kind=Kind.HELLO) / Raw(payload)))
    assert not packet.haslayer(Statement)
    assert packet[Raw].load == payload


def test_a_part_of_a_longer_statement_is_shown_raw() -> None:
    packet = Ether(bytes(Ether() / GDP(kind=Kind.HELLO, parts=2) / Raw(statement({"t": "hello"}))))
    assert not packet.haslayer(Statement)


def test_sealed_bytes_that_look_like_a_statement_are_shown_raw() -> None:
    packet = Ether(bytes(Ether() / GDP(kind=Kind.DATA) / Raw(statement({"t": "hello"}))))
    assert not packet.haslayer(Statement)
