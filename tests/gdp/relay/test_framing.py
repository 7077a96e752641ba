"""Framing of frames and control messages on a stream."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import DropReason, FrameError
from gdp.relay.framing import (
    KEEPALIVE,
    MTU_MAX,
    PREFIX,
    ControlMessage,
    ControlType,
    Deframer,
    is_gdp_frame,
    mtu_of,
)

FRAMES = st.binary(min_size=1, max_size=300)
CONTROLS = st.builds(ControlMessage, st.sampled_from(ControlType), st.binary(max_size=100))


def record(item: bytes | ControlMessage) -> bytes:
    return item.to_wire() if isinstance(item, ControlMessage) else PREFIX.pack(len(item)) + item


@given(st.lists(FRAMES | CONTROLS, max_size=12), st.data())
def test_a_stream_yields_the_same_records_however_it_is_split(
    items: list[bytes | ControlMessage], data: st.DataObject
) -> None:
    stream = b"".join(map(record, items))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    deframer = Deframer()
    frames: list[bytes] = []
    controls: list[ControlMessage] = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        more_frames, more_controls = deframer.receive_bytes(stream[start:end])
        frames += map(bytes, more_frames)
        controls += more_controls
    assert frames == [each for each in items if isinstance(each, bytes)]
    assert controls == [each for each in items if isinstance(each, ControlMessage)]


@given(st.lists(st.binary(max_size=200), max_size=5))
def test_arbitrary_bytes_are_records_or_raise_the_one_error(pieces: list[bytes]) -> None:
    deframer = Deframer(100)
    try:
        for piece in pieces:
            deframer.receive_bytes(piece)
    except FrameError:
        return


def test_a_length_above_the_mtu_is_refused_before_its_bytes_arrive() -> None:
    with pytest.raises(FrameError) as raised:
        Deframer(1_350).receive_bytes(PREFIX.pack(1_350 + 14 + 1))
    assert raised.value.reason is DropReason.TOO_BIG


def test_a_control_message_that_claims_32_kilobytes_is_refused() -> None:
    with pytest.raises(FrameError) as raised:
        Deframer().receive_bytes(PREFIX.pack(0xFFFF))
    assert raised.value.reason is DropReason.TOO_BIG


@pytest.mark.parametrize("wire", [PREFIX.pack(0), PREFIX.pack(0x8001) + b"\x63"], ids=["empty frame", "unknown type"])
def test_a_record_without_meaning_is_refused(wire: bytes) -> None:
    with pytest.raises(FrameError) as raised:
        Deframer().receive_bytes(wire)
    assert raised.value.reason is DropReason.MALFORMED


def test_a_keepalive_is_three_bytes() -> None:
    assert len(KEEPALIVE) == 3


@pytest.mark.parametrize("mtu", [0, 575, MTU_MAX + 1])
def test_an_mtu_that_no_relay_uses_is_refused(mtu: int) -> None:
    with pytest.raises(FrameError):
        mtu_of(ControlMessage.with_mtu(ControlType.OPEN, mtu))


def test_an_mtu_of_another_length_is_refused() -> None:
    with pytest.raises(FrameError):
        mtu_of(ControlMessage(ControlType.OPEN, b"\x05"))


def test_a_refusal_that_is_too_long_is_cut() -> None:
    _, (message,) = Deframer().receive_bytes(ControlMessage.refusal("x" * 10_000).to_wire())
    assert message.type is ControlType.REFUSED
    assert set(message.body) == {ord("x")}


@pytest.mark.parametrize(
    ("frame", "passes"),
    [
        (bytes(12) + b"\x88\xb5" + bytes(96), True),
        (bytes(12) + b"\x88\xb5" + bytes(95), False),
        (bytes(12) + b"\x08\x00" + bytes(96), False),
    ],
    ids=["ours", "short", "IPv4"],
)
def test_only_whole_frames_of_the_own_ethertype_pass(frame: bytes, passes: bool) -> None:
    assert is_gdp_frame(frame) is passes
