"""Strict CBOR reader, compared with an independent one and run on foreign bytes."""

from __future__ import annotations

import math

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.cbor import ITEMS_MAX, Value, decode, encode
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CBOR_DEPTH_MAX, CONTROL_MAX_BYTES

integers = st.integers(-(1 << 64), (1 << 64) - 1)
leaves = st.none() | st.booleans() | integers | st.floats(allow_nan=False) | st.binary(max_size=300) | st.text()
values = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4), max_leaves=20
)


def refused(wire: bytes) -> bool:
    with pytest.raises(StatementError) as caught:
        decode(wire)
    return caught.value.reason is DropReason.MALFORMED


@given(values)
def test_what_is_written_is_read(value: Value) -> None:
    assert decode(encode(value)) == value


@given(values)
def test_every_other_encoding_is_refused(value: Value) -> None:
    loose = cbor2.dumps(value)
    if loose != encode(value):
        assert refused(loose)


@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_read_bit_for_bit_or_refused(wire: bytes) -> None:
    try:
        value = decode(wire)
    except StatementError:
        assert refused(wire)
    else:
        assert encode(value) == wire


@given(st.lists(st.sampled_from([0x00, 0x18, 0x40, 0x61, 0x81, 0x82, 0xA1, 0xF4, 0xF9, 0xFA, 0xFB]), max_size=60))
def test_bytes_that_look_like_cbor_are_read_bit_for_bit_or_refused(initials: list[int]) -> None:
    wire = bytes(initials)
    try:
        value = decode(wire)
    except StatementError:
        return
    assert encode(value) == wire


def test_the_one_form_of_nan_is_read() -> None:
    number = decode(b"\xf9\x7e\x00")
    assert isinstance(number, float)
    assert math.isnan(number)


@pytest.mark.parametrize(
    ("wire", "why"),
    [
        ("", "nothing"),
        ("0000", "bytes after the end"),
        ("1817", "23 in two bytes"),
        ("1900ff", "255 in three"),
        ("1a0000ffff", "65535 in five"),
        ("1b00000000ffffffff", "2**32 - 1 in nine"),
        ("18", "no argument"),
        ("1c", "reserved"),
        ("5f4100ff", "indefinite bytes"),
        ("9fff", "indefinite array"),
        ("bfff", "indefinite map"),
        ("c000", "a tag"),
        ("c24101", "a big number"),
        ("d9d9f700", "self-described"),
        ("4200", "short bytes"),
        ("61ff", "not UTF-8"),
        ("63eda080", "a surrogate in UTF-8"),
        ("9b7fffffffffffffff", "an array that cannot be there"),
        ("bb7fffffffffffffff", "a map that cannot be there"),
        ("5b7fffffffffffffff", "bytes that cannot be there"),
        ("a1", "no key"),
        ("a161", "half a key"),
        ("a16161", "no value"),
        ("a10000", "a key that is a number"),
        ("a1414100", "a key that is bytes"),
        ("a2616200616100", "keys out of order"),
        ("a2616100616101", "a key twice"),
        ("a2626161006162 00".replace(" ", ""), "a longer key first"),
        ("a178016100", "a key with a long head"),
        ("f7", "undefined"),
        ("e0", "a simple value"),
        ("f8ff", "a simple value in two bytes"),
        ("ff", "a break"),
        ("f97e01", "a NaN with a message"),
        ("f9fe00", "a negative NaN"),
        ("fa7fc00000", "a long NaN"),
        ("fa3fc00000", "1.5 in four bytes"),
        ("fb3ff8000000000000", "1.5 in eight"),
        ("fb3ff0000020000000", "a float32 in eight"),
        ("fa7f800000", "infinity in four"),
        ("f93c", "half a float"),
        ("fb000000", "less than half a float"),
    ],
)
def test_what_has_another_reading_is_refused(wire: str, why: str) -> None:
    assert refused(bytes.fromhex(wire)), why


def test_nesting_is_read_to_its_limit_and_no_further() -> None:
    assert decode(b"\x81" * CBOR_DEPTH_MAX + b"\x00") is not None
    assert refused(b"\x81" * (CBOR_DEPTH_MAX + 1) + b"\x00")


@pytest.mark.parametrize("opening", ["81", "a16161", "9f", "82" + "00"])
def test_a_thousand_deep_is_refused_without_a_deep_stack(opening: str) -> None:
    assert refused(bytes.fromhex(opening) * 1_000)


def test_more_items_than_allowed_are_refused() -> None:
    assert len(decode(encode([0] * (ITEMS_MAX - 1)))) == ITEMS_MAX - 1  # type: ignore[arg-type]
    assert refused(encode([0] * ITEMS_MAX))


def test_more_bytes_than_allowed_are_refused() -> None:
    assert refused(encode(bytes(CONTROL_MAX_BYTES)))


@pytest.mark.parametrize(
    "value",
    [Ellipsis, [Ellipsis], {1: 2}, {"a": {b"b": 1}}, {1, 2}, bytearray(b"a"), 1 << 64, -(1 << 64) - 1, "\ud800"],
    ids=repr,
)
def test_what_has_no_place_in_a_statement_is_our_own_mistake(value: object) -> None:
    with pytest.raises(LocalError):
        encode(value)


def test_what_is_nested_too_deep_is_not_written() -> None:
    value: list[object] = []
    for _ in range(CBOR_DEPTH_MAX):
        value = [value]
    with pytest.raises(LocalError):
        encode(value)


@given(values)
def test_an_independent_reader_reads_the_same(value: Value) -> None:
    assert cbor2.loads(encode(value)) == value


@pytest.mark.parametrize("exponent", range(-30, 16))
def test_every_magnitude_of_a_half_is_written_in_two_bytes_of_float(exponent: int) -> None:
    number = math.ldexp(1.0 if exponent < -14 else 1.5, exponent) if exponent >= -24 else 0.0
    assert len(encode(number)) == 3
    assert decode(encode(number)) == number
