"""Signed statements: COSE_Sign1 in a form that other libraries read, and no other input."""

from __future__ import annotations

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, parse, sign
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CONTROL_MAX_BYTES
from gdp.names import Name

KEY = SigningKey.generate()
SIGNER = Name(bytes(range(32)))
WIRE = sign(StatementType.HELLO, {"seq": 7, "data": bytes(40)}, SIGNER, KEY)


def malformed(wire: bytes) -> bool:
    with pytest.raises(StatementError) as caught:
        parse(wire)
    return caught.value.reason is DropReason.MALFORMED


def test_a_general_cose_reader_finds_what_the_standard_says() -> None:
    outer = cbor2.loads(WIRE)
    assert outer.tag == 18
    protected, unprotected, payload, signature = outer.value
    assert cbor2.loads(protected) == {1: -7, 4: bytes(SIGNER)}
    assert unprotected == {}
    assert cbor2.loads(payload) == {"t": "hello", "seq": 7, "data": bytes(40)}
    KEY.public.verify(signature, cbor2.dumps(["Signature1", protected, b"", payload]))


@pytest.mark.parametrize("size", [0, 1, 8, 9, 14, 15, 230, 231, 232, 240, 241, 242, 5_000])
def test_every_length_of_payload_comes_back(size: int) -> None:
    wire = sign(StatementType.QUERY, {"d": bytes(size)}, SIGNER, KEY)
    assert wire == cbor2.dumps(cbor2.loads(wire), canonical=True)
    assert parse(wire).fields["d"] == bytes(size)


@pytest.mark.parametrize("type_", StatementType)
def test_every_type_comes_back_and_verifies(type_: StatementType) -> None:
    statement = parse(sign(type_, {"seq": 1}, SIGNER, KEY))
    statement.verify(KEY.public)
    assert (statement.type, statement.signer, dict(statement.fields)) == (type_, SIGNER, {"seq": 1})


def test_a_name_in_a_body_comes_back() -> None:
    assert parse(sign(StatementType.QUERY, {"n": SIGNER}, SIGNER, KEY)).fields["n"] == SIGNER


@given(st.integers(0, len(WIRE) - 1), st.integers(1, 255))
def test_every_changed_byte_is_malformed_or_breaks_the_signature(at: int, change: int) -> None:
    altered = bytearray(WIRE)
    altered[at] ^= change
    with pytest.raises(StatementError) as caught:
        parse(bytes(altered)).verify(KEY.public)
    assert caught.value.reason in (DropReason.MALFORMED, DropReason.BAD_SIGNATURE)


@pytest.mark.parametrize("cut", range(0, len(WIRE), 3))
def test_a_truncated_statement_is_malformed(cut: int) -> None:
    assert malformed(WIRE[:cut])


def test_bytes_after_the_end_are_malformed() -> None:
    assert malformed(WIRE + b"\x00")


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_malformed(wire: bytes) -> None:
    assert malformed(wire)


@given(st.binary(max_size=200))
def test_an_arbitrary_payload_is_read_or_malformed(payload: bytes) -> None:
    protected = cbor2.dumps({1: -7, 4: bytes(SIGNER)})
    wire = cbor2.dumps(cbor2.CBORTag(18, [protected, {}, payload, bytes(64)]))
    reason = None
    try:
        parse(wire)
    except StatementError as error:
        reason = error.reason
    assert reason in (None, DropReason.MALFORMED)


def cose(
    *,
    tag: int = 18,
    protected: dict[int, object] | None = None,
    unprotected: dict[int, object] | None = None,
    payload: bytes = b"\xa1atehello",
    signature: bytes = bytes(64),
) -> bytes:
    head = cbor2.dumps(protected if protected is not None else {1: -7, 4: bytes(SIGNER)})
    return cbor2.dumps(cbor2.CBORTag(tag, [head, unprotected or {}, payload, signature]))


def test_the_builder_of_the_following_cases_is_right() -> None:
    assert parse(cose()).type is StatementType.HELLO


@pytest.mark.parametrize(
    "wire",
    [
        cose(tag=17),
        cose(protected={1: -7}),
        cose(protected={1: -35, 4: bytes(SIGNER)}),
        cose(protected={1: -7, 4: bytes(31)}),
        cose(protected={4: bytes(SIGNER), 1: -7}),
        cose(protected={1: -7, 4: bytes(SIGNER), 5: 0}),
        cose(unprotected={4: b"x"}),
        cose(signature=bytes(63)),
        cose(signature=bytes(65)),
        cose(payload=b""),
        cose(payload=b"\x00"),
        cose(payload=b"\xa0"),
        cose(payload=b"\xa1atgunknown"),
        cose(payload=b"\xa1at\x01"),
        cose(payload=b"\xa1at\x80"),
        cose(payload=b"\xa1atehello\x00"),
        cose(payload=b"\xa2atehelloax\xc0\x00"),
        cose(payload=b"\xa1ax" * 1_000),
        cose(payload=b"\x81" * 1_000 + b"\x00"),
    ],
)
def test_other_forms_are_malformed(wire: bytes) -> None:
    assert malformed(wire)


def test_a_payload_with_too_long_a_head_is_malformed() -> None:
    payload = cbor2.dumps({"t": "hello"})
    loose = cose(payload=payload).replace(b"\x49" + payload, b"\x58\x09" + payload)
    assert loose != cose(payload=payload)
    assert malformed(loose)


def test_a_statement_of_another_type_than_expected_is_malformed() -> None:
    with pytest.raises(StatementError) as caught:
        parse(WIRE).expect(StatementType.QUERY)
    assert caught.value.reason is DropReason.MALFORMED


def test_a_second_signature_leaves_the_fingerprint_as_it_is() -> None:
    again = sign(StatementType.HELLO, {"seq": 7, "data": bytes(40)}, SIGNER, KEY)
    assert again != WIRE
    assert parse(again).fingerprint == parse(WIRE).fingerprint


def test_a_body_too_long_is_our_own_mistake() -> None:
    with pytest.raises(LocalError):
        sign(StatementType.HELLO, {"d": bytes(CONTROL_MAX_BYTES)}, SIGNER, KEY)


def test_a_body_that_names_its_type_is_our_own_mistake() -> None:
    with pytest.raises(LocalError):
        sign(StatementType.HELLO, {"t": "query"}, SIGNER, KEY)
