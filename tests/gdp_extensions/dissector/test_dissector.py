"""Dissector for Wireshark: tshark shows what Scapy shows, and marks what a receiver refuses."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import cbor2
import pytest
from scapy.fields import StrField
from scapy.packet import Raw

from gdp.errors import FrameError, LocalError
from gdp.frame.codec import HEADER_BYTES, Flag, Kind, decode, ethernet
from gdp.frame.layers import GDP, PAYLOADS, STATEMENTS, Statement, least_bytes
from gdp_extensions.dissector.dissector import _field, dissector
from tests.draws import IS_LONG
from tests.gdp_extensions.dissector.tshark import assert_same, needs_tshark, shown_by_tshark, write_pcap

ETHER: Final = ethernet(b"\x02\0\0\0\0\x01", b"\x02\0\0\0\0\x02")
VECTORS: Final = json.loads((Path(__file__).parents[2] / "vectors" / "frames.json").read_text())["frames"]
SEED: Final = 15


def _item(rng: random.Random, depth: int = 0) -> object:
    """Return a value for a statement's body: any type that the notation knows, and some that it does not."""
    choice = rng.randrange(14 if depth < 3 else 10)
    if choice < 2:
        return rng.choice(
            [0, 23, 24, 255, 256, 65_535, 1 << 31, 1 << 53, (1 << 53) + 1, (1 << 64) - 1, rng.getrandbits(40)]
        )
    if choice == 2:
        return -1 - rng.choice([0, 23, 24, 1 << 32, (1 << 64) - 1, rng.getrandbits(63)])
    if choice == 3:
        return rng.randbytes(rng.choice([0, 1, 31, 32, 33, 300]))
    if choice == 4:
        return rng.choice(["", 'é\n\t"\\', "/camera", "\x7f\x00", "😀 \u2028", "x" * 400])
    if choice == 5:
        return rng.choice([True, False, None, cbor2.undefined])
    if choice < 8:
        shown = [
            2**-44,
            -7.291122019556398e-304,
            0.0,
            -0.0,
            1.5,
            1e16,
            1e15,
            123456.789,
            1e-5,
            1e-4,
            5e-324,
            1.7976931348623157e308,
            0.1,
            1 / 3,
        ]
        return rng.choice(
            [*shown, float("inf"), float("-inf"), float("nan"), rng.uniform(-1e6, 1e6), rng.gauss(0, 1e-9)]
        )
    if choice == 8:
        return cbor2.dumps({rng.randrange(9): rng.randbytes(3)})  # shown as embedded
    if choice == 9:
        return cbor2.CBORSimpleValue(rng.choice([3, 99]))
    if choice == 10:
        return cbor2.CBORTag(rng.choice([18, 99_999, 1 << 60]), _item(rng, depth + 1))
    if choice == 11:
        return {rng.choice([1, "k", -3, "longer"]): _item(rng, depth + 1) for _ in range(rng.randrange(4))}
    return [_item(rng, depth + 1) for _ in range(rng.randrange(5))]


def _statement(rng: random.Random) -> bytes:
    protected = cbor2.dumps({1: -7, 4: rng.randbytes(32)})
    body = cbor2.dumps(_item(rng), canonical=rng.random() < 0.5)
    return cbor2.dumps(cbor2.CBORTag(18, [protected, {}, body, rng.randbytes(64)]))


def _whole(rng: random.Random) -> Iterator[bytes]:
    """Yield frames of every kind, known or not, without and with *last*."""
    kinds = [*Kind, 0x00, 0x7E, 0xFE]
    for kind, flags in ((kind, flags) for kind in kinds for flags in (0, Flag.LAST, 0xFF)):
        head = GDP(kind=kind, flags=flags, hops_left=rng.getrandbits(8), epoch=rng.getrandbits(16))
        head.number, head.incarnation = rng.getrandbits(64), rng.getrandbits(64)
        head.destination, head.source = rng.randbytes(32), rng.randbytes(32)
        payloads = [rng.randbytes(rng.randrange(200)), b""]
        if kind in PAYLOADS:
            least = least_bytes(PAYLOADS[kind][bool(flags & 1)])
            payloads += [rng.randbytes(least + extra) for extra in (-1, 0, 1)]
        if kind in STATEMENTS:
            payloads += [_statement(rng) for _ in range(12 if IS_LONG else 4)]
        for payload in payloads:
            padding = b"" if rng.random() < 0.5 else rng.randbytes(rng.randrange(1, 46))
            yield ETHER + bytes(head / Raw(payload)) + padding


def _frames() -> list[bytes]:
    rng = random.Random(SEED)
    whole = [*(ETHER + bytes.fromhex(each["hex"]) for each in VECTORS if each["hex"]), *_whole(rng)]
    statements = [each for each in whole if len(each) > 14 + HEADER_BYTES and each[15] in STATEMENTS]
    broken = [each[: rng.randrange(14, len(each) + 1)] for each in whole]
    for each in (*whole, *statements, *statements, *statements):
        twisted = bytearray(each)
        for _ in range(rng.randrange(1, 3)):
            twisted[rng.randrange(14, len(each))] ^= 1 << rng.randrange(8)
        broken.append(bytes(twisted))
    deep = [cbor2.dumps([]), *(b"\x81" * depth + b"\x01" for depth in range(1, 40))]
    broken += [ETHER + bytes(GDP(kind=Kind.HELLO) / Raw(_wrapped(each))) for each in deep]
    return [each for each in (*whole, *broken) if len(each) > 14]


def _wrapped(body: bytes) -> bytes:
    return bytes(Statement(protected=b"\xa0", body=body, signature=b"s" * 64))


def _is_refused(frame: bytes) -> bool:
    """Return whether a receiver refuses a frame by its form alone, or its payload has not the form of its kind."""
    wire = frame[14:]
    try:
        header = decode(wire)
    except FrameError:
        return True
    shown = GDP(wire).payload
    if header.kind in STATEMENTS:
        return header.parts == 1 and not isinstance(shown, Statement)
    return header.kind in PAYLOADS and not isinstance(shown, PAYLOADS[header.kind])


@needs_tshark
def test_every_field_of_frames_of_every_kind_equals_scapys_and_malformed_ones_are_marked(tmp_path: Path) -> None:
    frames = _frames()
    assert {bytes([kind]) for kind in Kind} <= {each[15:16] for each in frames}
    write_pcap(tmp_path / "made.pcap", frames)
    shown = shown_by_tshark(tmp_path / "made.pcap", tmp_path)
    assert_same(frames, shown)
    marked = ["gdp.malformed.reason" in fields for fields in shown]
    assert marked == list(map(_is_refused, frames))
    assert 200 < sum(marked) < len(frames) - 200


@needs_tshark
def test_a_frame_that_the_capture_cut_is_not_called_malformed(tmp_path: Path) -> None:
    frame = ETHER + bytes(GDP(kind=Kind.DATA) / Raw(b"x" * 500))
    write_pcap(tmp_path / "cut.pcap", [frame])
    data = bytearray((tmp_path / "cut.pcap").read_bytes())
    data[24 + 8 : 24 + 12] = (len(frame) - 100).to_bytes(4, "little")
    (tmp_path / "cut.pcap").write_bytes(data[:-100])
    (shown,) = shown_by_tshark(tmp_path / "cut.pcap", tmp_path)
    assert "gdp.malformed.reason" not in shown
    assert "gdp.cut" in shown


def test_the_generator_knows_every_field_of_the_layers_and_refuses_another() -> None:
    text = dissector()
    assert "@tables@" not in text
    with pytest.raises(LocalError, match="StrField"):
        _field(StrField("strange", b""))
