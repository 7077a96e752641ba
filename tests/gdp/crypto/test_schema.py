"""Forms of the fields of a body: what each reads, what it refuses, and that it writes what it reads."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any

import pytest

from gdp.crypto.schema import (
    FLAG,
    MAP,
    NAME,
    NAME_OR_ZERO,
    OCTETS,
    REASON,
    Body,
    FieldSet,
    Form,
    Keyed,
    Spread,
    inner,
    joined,
    literal,
    many,
    mapped,
    number,
    octets,
    one_of,
    or_empty,
    packed,
    row,
    text,
    uint,
)
from gdp.errors import DropReason, StatementError
from gdp.names import NAME_BYTES, ZERO, Name

SOME = Name(b"n" * NAME_BYTES)
PAIR: Form[Any] = row(lambda *each: each, uint(9), FLAG)
TWO: Form[Any] = packed(2, lambda value: (value[0], value[1]), bytes)


class Word(str, Enum):
    """A word."""

    YES = "yes"


@dataclass(frozen=True)
class Around(FieldSet):
    """A map with a field of two keys."""

    MAX_BYTES = 16
    pair: Annotated[tuple[int, int], Spread((Keyed("a", uint(9)), Keyed("b", uint(9))), lambda *each: each, tuple)]
    size: Annotated[int, Keyed("s", uint(999))]


@dataclass(frozen=True)
class Inner(Body):
    """A body in a body."""

    size: Annotated[int, Keyed("s", uint(9))]


@dataclass(frozen=True)
class Outer(Body):
    """A body with a field that may be absent, one that is left out, and one that does not travel."""

    inner: Annotated[Inner, Keyed("i", inner(Inner))]
    word: Annotated[str, Keyed("w", text(4), absent="none")] = "none"
    extra: Annotated[bytes, Keyed("x", OCTETS, absent=b"", is_omitted=True)] = b""
    here: int = 0

    def check(self) -> None:
        """Refuse one word."""
        if self.word == "bad":
            raise StatementError(DropReason.TOO_BIG, "a word")


@pytest.mark.parametrize(
    ("form", "wire", "value"),
    [
        (uint(9, 2), 2, 2),
        (number(0, 9), 3, 3.0),
        (text(3), "abc", "abc"),
        (FLAG, True, True),
        (OCTETS, b"", b""),
        (octets(2), b"ab", b"ab"),
        (octets(most=2), b"a", b"a"),
        (NAME, bytes(SOME), SOME),
        (NAME_OR_ZERO, bytes(NAME_BYTES), ZERO),
        (or_empty(octets(2), None), b"", None),
        (or_empty(octets(2), None), b"ab", b"ab"),
        (many(uint(9), 2), [1, 2], (1, 2)),
        (literal("a", "b"), "b", "b"),
        (literal(1, 2), 1, 1),
        (one_of(Word), "yes", Word.YES),
        (mapped(uint(9), str, int), 7, "7"),
        (PAIR, [1, False], (1, False)),
        (TWO, b"ab", (97, 98)),
        (joined(2, bytes, bytes, 2), b"abcd", (b"ab", b"cd")),
        (REASON, 255, None),
        (REASON, 36, DropReason.IN_USE),
        (MAP, {"a": 1}, {"a": 1}),
        (inner(Inner), {"s": 3}, Inner(3)),
    ],
)
def test_a_form_reads_what_fits_and_writes_it_again(form: Form[Any], wire: Any, value: Any) -> None:
    assert form.read(wire) == value
    assert form.write(value) == wire


@pytest.mark.parametrize(
    ("form", "wires"),
    [
        (uint(9, 2), (1, 10, True, 2.0, "2", None)),
        (number(0, 9), (-1, 10, float("nan"), True, None)),
        (text(3), ("abcd", b"abc")),
        (FLAG, (0, 1, None)),
        (octets(2), (b"a", b"abc", "ab")),
        (octets(most=2), (b"abc",)),
        (NAME, (bytes(NAME_BYTES), b"short", SOME.to_text())),
        (or_empty(octets(2), None), (b"a", None)),
        (many(uint(9), 2), ([1, 2, 3], [10], "ab", {"a": 1})),
        (literal("a", "b"), ("c", b"a", 1)),
        (literal(1, 2), (True, 1.0, 3)),
        (one_of(Word), ("no", b"yes", ["yes"], None)),
        (mapped(uint(9), str, int), (10, "7")),
        (PAIR, ([1], [1, False, 2], [10, False], [1, 0])),
        (joined(2, bytes, bytes, 2), (b"a", b"abcdef")),
        (REASON, (256, -1, None)),
        (MAP, ([], None)),
    ],
)
def test_a_form_refuses_what_does_not_fit(form: Form[Any], wires: tuple[Any, ...]) -> None:
    for wire in wires:
        with pytest.raises(ValueError, match=r"\w"):
            form.read(wire)


def test_a_list_that_is_not_cut_is_sent_whole() -> None:
    assert many(uint(9), 2).write((1, 2, 3)) == [1, 2]
    assert many(uint(9), 2, is_cut=False).write((1, 2, 3)) == [1, 2, 3]


@pytest.mark.parametrize("form", [uint(9, 2), text(3), octets(2), NAME, PAIR, many(FLAG, 2), literal(1, 2), REASON])
def test_a_form_reads_its_edges(form: Form[Any]) -> None:
    assert len([form.read(each) for each in form.edges]) == len(form.edges) > 0


def test_a_field_of_several_keys_stands_among_the_others_whatever_else_does() -> None:
    sent: dict[str, Any] = Around((1, 2), 3).to_fields()
    assert sent == {"a": 1, "b": 2, "s": 3}
    assert Around.from_fields({**sent, "": {"a": 9}}) == Around((1, 2), 3)
    for key in sent:
        with pytest.raises(StatementError, match=repr(key)):
            Around.from_fields({**sent, key: "x"})


def test_an_encoded_map_is_read_up_to_its_length() -> None:
    wire = Around((1, 2), 3).to_cbor()
    assert Around.from_cbor(wire) == Around((1, 2), 3)
    for other in (b"", b"\x01", Around((1, 2), 300).to_cbor() + bytes(20)):
        with pytest.raises(StatementError):
            Around.from_cbor(other)


def test_a_refusal_of_a_later_version_is_a_refusal() -> None:
    assert REASON.read(254) is DropReason.MALFORMED


def test_a_field_may_be_absent_left_out_or_given() -> None:
    body = Outer(Inner(3))
    assert body.to_fields() == {"i": {"s": 3}, "w": "none"}
    assert Outer.from_fields({"i": {"s": 3}, "later": 1}, here=7) == Outer(Inner(3), here=7)
    assert Outer(Inner(3), extra=b"x").to_fields()["x"] == b"x"


@pytest.mark.parametrize(
    ("items", "reason"),
    [
        ({}, DropReason.MALFORMED),
        ({"i": {"s": 10}}, DropReason.MALFORMED),
        ({"i": {"s": 3}, "w": None}, DropReason.MALFORMED),
        ({"i": {"s": 3}, "w": "bad"}, DropReason.TOO_BIG),
    ],
)
def test_a_body_that_does_not_fit_is_refused_with_its_reason(items: dict[str, Any], reason: DropReason) -> None:
    with pytest.raises(StatementError) as caught:
        Outer.from_fields(items)
    assert caught.value.reason is reason
