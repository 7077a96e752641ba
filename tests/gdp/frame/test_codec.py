"""Frame codec: round trips, refusals, and the sealed part of a header."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import DropReason, FrameError
from gdp.frame.codec import (
    HEADER_BYTES,
    HOPS_AT,
    HOPS_MASK,
    SECOND_PATH,
    Header,
    authenticated,
    decode,
    encode,
    ethernet,
    second_path_copy,
    second_path_key,
)
from tests.gdp.frame.frames import frames

VECTORS = json.loads((Path(__file__).parents[2] / "vectors" / "frames.json").read_text())["frames"]


@given(frames())
def test_what_is_encoded_decodes_to_the_same(made: tuple[Header, bytes, bytes]) -> None:
    header, payload, padding = made
    assert decode(encode(header) + payload + padding) == header


@given(st.binary(max_size=200))
def test_arbitrary_bytes_decode_or_raise_frame_error(data: bytes) -> None:
    try:
        header = decode(data)
    except FrameError:
        return
    assert HEADER_BYTES + header.length <= len(data)


@given(frames(), st.integers(0, 255))
def test_a_seal_covers_everything_but_hops_left(made: tuple[Header, bytes, bytes], hops_left: int) -> None:
    header = made[0]
    covered = authenticated(encode(header))
    assert len(covered) == HEADER_BYTES - 1
    assert covered == authenticated(encode(header._replace(hops_left=hops_left)))
    assert covered != authenticated(encode(header._replace(kind=header.kind ^ 1)))


def test_hops_left_stands_where_the_codec_says() -> None:
    header = Header(1, 2, 0x99, 4, 0, 5, 0, 1, 6, bytes(32), bytes(32))
    assert encode(header)[HOPS_AT] == 0x99


@given(frames())
def test_a_second_copy_differs_in_one_bit_outside_the_seal(made: tuple[Header, bytes, bytes]) -> None:
    header, payload, padding = made
    first = encode(header._replace(hops_left=header.hops_left & HOPS_MASK)) + payload + padding
    second = second_path_copy(first)
    assert [(at, a ^ b) for at, (a, b) in enumerate(zip(first, second, strict=True)) if a != b] == [
        (HOPS_AT, SECOND_PATH)
    ]
    assert authenticated(second) == authenticated(first)


@given(st.binary(min_size=32, max_size=64))
def test_the_key_of_the_second_path_differs_in_the_last_bit_of_the_destination(key: bytes) -> None:
    second = second_path_key(key)
    assert [(at, a ^ b) for at, (a, b) in enumerate(zip(key, second, strict=True)) if a != b] == [(31, 1)]
    assert second_path_key(second) == key


def test_the_ethernet_header_carries_the_ethertype() -> None:
    assert ethernet(b"\x01" * 6, b"\x02" * 6).hex() == "01010101010102020202020288b5"


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["what"])
def test_the_published_frames_come_out(vector: dict[str, object]) -> None:
    wire = bytes.fromhex(str(vector["hex"]))
    if "refused" in vector:
        with pytest.raises(FrameError) as caught:
            decode(wire)
        assert caught.value.reason.label == vector["refused"]
        return
    header = decode(wire)
    fields = {key: value.hex() if isinstance(value, bytes) else value for key, value in header._asdict().items()}
    for key in ("number", "incarnation"):
        fields[key] = str(fields[key])
    assert fields == vector["header"]
    payload, padding = bytes.fromhex(str(vector["payload"])), bytes.fromhex(str(vector["padding"]))
    assert encode(header) + payload + padding == wire


def test_each_refusal_has_a_published_frame() -> None:
    refused = {vector["refused"] for vector in VECTORS if "refused" in vector}
    assert refused == {r.label for r in (DropReason.TRUNCATED, DropReason.BAD_VERSION, DropReason.BAD_PARTS)}
