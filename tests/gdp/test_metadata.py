"""Metadata: permitted content, and that the canonical bytes are the only ones."""

from __future__ import annotations

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.metadata import KINDS, Metadata

keys = st.text(min_size=1, max_size=30).filter(lambda key: key != "kind")
values = st.text(max_size=40) | st.integers(-(1 << 63), (1 << 64) - 1)
maps = st.dictionaries(keys, values, max_size=8)


@given(maps, st.randoms(use_true_random=False))
def test_the_order_of_the_keys_does_not_matter(items: dict[str, str | int], random: object) -> None:
    pairs = [*items.items(), ("kind", "topic")]
    random.shuffle(pairs)  # type: ignore[attr-defined]
    assert Metadata(dict(pairs)).to_wire() == Metadata({**items, "kind": "topic"}).to_wire()


@given(maps)
def test_keys_stand_in_bytewise_order_of_their_encoding(items: dict[str, str | int]) -> None:
    wire = Metadata({**items, "kind": "topic"}).to_wire()
    encoded = [cbor2.dumps(key) for key in cbor2.loads(wire)]
    assert encoded == sorted(encoded)


def test_another_owner_gives_another_name() -> None:
    metadata = Metadata({"kind": "topic"})
    assert metadata.name(b"\x02" + bytes(32)) != metadata.name(b"\x03" + bytes(32)) != metadata.name()


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_is_accepted(kind: str) -> None:
    assert Metadata({"kind": kind})["kind"] == kind


@pytest.mark.parametrize(
    "items",
    [
        {},
        {"kind": "planet"},
        {"kind": "chapter"},
        {"kind": "replica"},
        {"kind": "topic", "": "x"},
        {"kind": "topic", 1: "x"},
        {"kind": "topic", "x": 1.5},
        {"kind": "topic", "x": True},
        {"kind": "topic", "x": None},
        {"kind": "topic", "x": ["y"]},
        {"kind": "topic", "x": 1 << 64},
        {"kind": "topic", "x": -(1 << 63) - 1},
        {"kind": "topic", "x": "y" * 4_097},
    ],
    ids=repr,
)
def test_metadata_of_the_wrong_form_are_refused(items: dict[str, str | int]) -> None:
    with pytest.raises(LocalError):
        Metadata(items)


def test_metadata_do_not_change_with_the_map_they_were_made_from() -> None:
    items: dict[str, str | int] = {"kind": "topic"}
    metadata = Metadata(items)
    items["name"] = "/later"
    assert dict(metadata) == {"kind": "topic"}
