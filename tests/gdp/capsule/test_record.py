"""Records: exact, or refused; found again behind damaged bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.capsule.record import Record, RecordType, body_of, find, split
from gdp.errors import RemoteError
from tests.draws import draws

RECORD = Record(RecordType.MESSAGE, 7, 1_000, 3, 2, body_of([b"one", b"two"]))


def test_a_record_is_read_as_written() -> None:
    assert Record.from_wire(RECORD.to_wire()) == RECORD
    assert RECORD.frames == [b"one", b"two"]


@given(st.binary(max_size=120))
@draws(200)
def test_arbitrary_bytes_are_a_record_or_refused(wire: bytes) -> None:
    with pytest.raises(RemoteError):
        Record.from_wire(wire)


@given(st.integers(min_value=0), st.integers(0, 7))
@draws(100)
def test_a_flipped_bit_is_refused(at: int, bit: int) -> None:
    wire = bytearray(RECORD.to_wire())
    wire[at % len(wire)] ^= 1 << bit
    with pytest.raises(RemoteError):
        Record.from_wire(bytes(wire))


@pytest.mark.parametrize("body", [b"\0", b"\0\4abc", b"\0\0"], ids=["half a length", "cut", "empty frame"])
def test_frames_fill_their_record(body: bytes) -> None:
    with pytest.raises(RemoteError):
        _ = RECORD._replace(body=body).frames


def test_a_part_of_a_record_waits_for_its_rest() -> None:
    wire = RECORD.to_wire()
    assert list(split(wire * 2 + wire[:-1])) == [wire, wire]
    with pytest.raises(RemoteError):
        list(split(b"\xff" * 40))


def test_the_next_record_is_found_behind_damaged_bytes() -> None:
    wire = RECORD.to_wire()
    assert find(b"damage" + wire, 0) == 6
    assert find(wire[1:], 0) is None
