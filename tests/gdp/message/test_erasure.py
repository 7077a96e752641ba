"""Erasure code: any k shards of a block and its parity give the block."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.message.erasure import DATA_MAX, PARITY_MAX, decode, encode


def block(k: int, size: int, seed: int = 1) -> list[bytes]:
    """Return random shards."""
    rng = random.Random(seed)
    return [rng.randbytes(size) for _ in range(k)]


@given(k=st.integers(1, DATA_MAX), m=st.integers(1, PARITY_MAX), size=st.integers(1, 40), seed=st.integers(0, 1 << 32))
def test_any_k_of_all_shards_give_the_block(k: int, m: int, size: int, seed: int) -> None:
    shards = block(k, size, seed)
    parity = encode(shards, m)
    rng = random.Random(seed)
    lost = rng.sample(range(k + m), rng.randint(0, m))
    here = {place: shards[place] for place in range(k) if place not in lost}
    came = {index: parity[index] for index in range(m) if k + index not in lost}
    assert decode(here, came, k) == {place: shards[place] for place in range(k) if place in lost}


def test_a_full_block_that_lost_as_much_as_it_has_parity_comes_back() -> None:
    shards = block(DATA_MAX, 1_476)
    parity = encode(shards, PARITY_MAX)
    here = dict(enumerate(shards[: DATA_MAX - PARITY_MAX]))
    assert here | decode(here, dict(enumerate(parity)), DATA_MAX) == dict(enumerate(shards))


def test_the_first_parity_shard_is_the_xor_of_the_block() -> None:
    shards = block(5, 8)
    xored = 0
    for each in shards:
        xored ^= int.from_bytes(each, "big")
    assert encode(shards, 1) == [xored.to_bytes(8, "big")]


def test_a_parity_shard_does_not_depend_on_how_many_there_are() -> None:
    shards = block(9, 33)
    assert encode(shards, 7)[:3] == encode(shards, 3)


def product(a: int, b: int) -> int:
    """Return the product in GF(256), bit by bit."""
    result = 0
    while b:
        result ^= a if b & 1 else 0
        a = a << 1 ^ (0x11D if a & 0x80 else 0)
        b >>= 1
    return result


def test_the_coefficients_are_those_of_the_specification() -> None:
    for place in (0, 1, 2, 77, 127):
        shards = [bytes([at == place]) for at in range(DATA_MAX)]
        for index, (coefficient,) in enumerate(encode(shards, PARITY_MAX)):
            assert product(coefficient, 128 + index ^ place) == 128 ^ place


@pytest.mark.parametrize(
    ("k", "m", "sizes"), [(0, 1, ()), (129, 1, (1,) * 129), (2, 0, (1, 1)), (2, 33, (1, 1)), (2, 1, (1, 2))]
)
def test_bounds_are_checked_before_encoding(k: int, m: int, sizes: tuple[int, ...]) -> None:
    with pytest.raises(LocalError):
        encode([bytes(size) for size in sizes], m)


@pytest.mark.parametrize(("here", "came"), [({0: b"a"}, {}), ({0: b"a"}, {0: b"ab"}), ({0: b"a"}, {PARITY_MAX: b"a"})])
def test_too_little_or_shards_of_other_lengths_do_not_decode(here: dict[int, bytes], came: dict[int, bytes]) -> None:
    with pytest.raises(LocalError):
        decode(here, came, 2)
