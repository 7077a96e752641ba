"""Diagnostic notation of statements (CBOR, RFC 8949, section 8)."""

from __future__ import annotations

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.frame.diagnostic import byte_string, diagnose
from gdp.limits import CBOR_DEPTH_MAX, CONTROL_MAX_BYTES

plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 63), (1 << 64) - 1) | st.binary(max_size=8) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@given(plain)
def test_whatever_a_statement_may_carry_has_a_text(value: object) -> None:
    assert diagnose(cbor2.dumps(value)) is not None


@given(st.binary(max_size=200))
def test_arbitrary_bytes_have_a_text_or_none(data: bytes) -> None:
    text = diagnose(data)
    assert text is None or text.isprintable()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (-500, "-500"),
        ("a\x1b[31m\x9b", '"a\\u001b[31m\\u009b"'),
        (b"\x01\x02", "h'0102'"),
        (b"x" * 40, "h'7878787878787878…' (40 bytes)"),
        ([1, [True, None]], "[1, [true, null]]"),
        (1.5, "1.5"),
        (cbor2.dumps({"a": 1}), '<<{"a": 1}>>'),
        (cbor2.CBORTag(18, [1]), "18([1])"),
    ],
)
def test_values_are_written_as_rfc_8949_does(value: object, text: str) -> None:
    assert diagnose(cbor2.dumps(value)) == text


def test_deeper_than_the_limit_is_none() -> None:
    assert diagnose(b"\x81" * CBOR_DEPTH_MAX + b"\x00") is not None
    assert diagnose(b"\x81" * (CBOR_DEPTH_MAX + 1) + b"\x00") is None
    assert diagnose(b"\x81" * 1_000 + b"\x00") is None


def test_longer_than_the_limit_is_none() -> None:
    assert diagnose(cbor2.dumps(bytes(CONTROL_MAX_BYTES))) is None


@pytest.mark.parametrize("data", [b"", b"\x9f\xff", b"\x00\x00", b"\x58", b"\xf7", b"\xf8\x14", b"\x9b" + b"\xff" * 8])
def test_anything_else_is_none(data: bytes) -> None:
    assert diagnose(data) is None


def test_a_byte_string_is_found_behind_its_head() -> None:
    data = cbor2.dumps(b"x" * 300) + b"rest"
    start, end = byte_string(data)
    assert data[start:end] == b"x" * 300


@pytest.mark.parametrize("data", [b"", b"\x42a", b"\x60", b"\x5b" + b"\xff" * 8])
def test_no_byte_string_is_a_value_error(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"no byte string|ends early"):
        byte_string(data)
