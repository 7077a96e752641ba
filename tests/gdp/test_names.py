"""Names: their published vectors, and their forms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gdp.errors import LocalError
from gdp.metadata import Metadata
from gdp.names import ZERO, Name, name_of

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "names.json").read_text())["vectors"]
each_vector = pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["what"].replace(" ", "-"))


@each_vector
def test_metadata_have_the_published_canonical_bytes(vector: dict[str, Any]) -> None:
    assert Metadata(vector["metadata"]).to_wire().hex() == vector["cbor"]


@each_vector
def test_metadata_have_the_published_digest(vector: dict[str, Any]) -> None:
    assert Metadata(vector["metadata"]).digest().hex() == vector["digest"]


@each_vector
def test_digest_and_key_give_the_published_name(vector: dict[str, Any]) -> None:
    name = name_of(bytes.fromhex(vector["digest"]), bytes.fromhex(vector["owner_key"]))
    assert (name.to_text(), name.short) == (vector["name"], vector["short"])


def test_the_published_names_all_differ() -> None:
    assert len({vector["name"] for vector in VECTORS}) == len(VECTORS)


def test_a_name_is_found_in_a_table_by_the_bytes_of_a_frame() -> None:
    table: dict[bytes, int] = {Name(bytes(range(32))): 1}
    assert table[bytes(range(32))] == 1


def test_text_form_keeps_leading_zeros_and_comes_back() -> None:
    name = Name(bytes(31) + b"\x01")
    assert name.to_text() == "0" * 63 + "1"
    assert Name.from_text(name.to_text()) == name


@pytest.mark.parametrize("text", ["", "0" * 63, "0" * 65, "g" * 64, " " + "0" * 63, "0x" + "0" * 62, "٠" * 64])
def test_text_that_is_not_64_hex_digits_is_refused(text: str) -> None:
    with pytest.raises(LocalError):
        Name.from_text(text)


@pytest.mark.parametrize("size", [0, 31, 33])
def test_other_than_32_bytes_are_no_name(size: int) -> None:
    with pytest.raises(LocalError):
        Name(bytes(size))


@pytest.mark.parametrize(("digest", "key"), [(31, 33), (33, 33), (32, 1), (32, 32), (32, 65)])
def test_parts_of_the_wrong_length_make_no_name(digest: int, key: int) -> None:
    with pytest.raises(LocalError):
        name_of(bytes(digest), bytes(key))


def test_a_repr_never_shows_a_whole_name() -> None:
    assert ZERO.to_text() not in repr(ZERO)
