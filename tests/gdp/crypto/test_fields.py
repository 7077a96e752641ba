"""Typed reading of a statement's body."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gdp.crypto.fields import Fields
from gdp.crypto.schema import NAME
from gdp.errors import DropReason, StatementError
from gdp.names import Name

SOME = Name(bytes(range(32)))
FIELDS = Fields(
    {
        "uint": 7,
        "negative": -1,
        "float": 1.5,
        "nan": float("nan"),
        "flag": True,
        "text": "abc",
        "bytes": b"abc",
        "name": bytes(SOME),
        "names": [bytes(SOME), bytes(SOME)],
        "mixed": [1, "a", b"b", None],
        "texts": ["a", "b"],
        "maps": [{"inner": 1}, {"inner": 2}],
        "null": None,
    }
)


def test_each_accessor_returns_its_type() -> None:
    assert FIELDS.uint("uint") == 7
    assert FIELDS.number("float", 0, 2) == 1.5
    assert FIELDS.number("uint", 0, 7) == 7.0
    assert FIELDS.flag("flag") is True
    assert FIELDS.text("text") == "abc"
    assert FIELDS.bytes_("bytes") == b"abc"
    assert FIELDS.read("name", NAME) == SOME
    assert FIELDS.texts("texts", 2) == ["a", "b"]
    assert FIELDS.byte_strings("names", 2) == [SOME, SOME]
    assert [each.uint("inner") for each in FIELDS.maps("maps", 2)] == [1, 2]


@pytest.mark.parametrize(
    "read",
    [
        lambda f: f.uint("absent"),
        lambda f: f.uint("negative"),
        lambda f: f.uint("flag"),
        lambda f: f.uint("float"),
        lambda f: f.uint("uint", 6),
        lambda f: f.number("nan", -1, 1),
        lambda f: f.number("flag", 0, 2),
        lambda f: f.number("float", 0, 1),
        lambda f: f.number("text", 0, 1),
        lambda f: f.flag("uint"),
        lambda f: f.flag("null"),
        lambda f: f.text("bytes"),
        lambda f: f.text("text", 2),
        lambda f: f.bytes_("text"),
        lambda f: f.bytes_("bytes", 4),
        lambda f: f.read("bytes", NAME),
        lambda f: f.byte_strings("text", 9),
        lambda f: f.byte_strings("names", 1),
        lambda f: f.texts("mixed", 9),
        lambda f: f.byte_strings("mixed", 9),
        lambda f: f.maps("mixed", 9),
        lambda f: f.maps("maps", 1),
    ],
)
def test_anything_else_is_malformed(read: Callable[[Fields], object]) -> None:
    with pytest.raises(StatementError) as caught:
        read(FIELDS)
    assert caught.value.reason is DropReason.MALFORMED
