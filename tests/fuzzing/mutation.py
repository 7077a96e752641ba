"""Mutations of inputs: bytes, splices with other inputs, words, and values within CBOR."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any, Final

import cbor2

from tests.fuzzing.decoder import Decoder

__all__ = ["mutated"]

_NUMBERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFF_FFFF, 0xFFFF_FFFF, (1 << 63) - 1, (1 << 64) - 1)
_VALUES: tuple[object, ...] = (
    None,
    True,
    -1,
    0,
    1 << 63,
    (1 << 64) - 1,
    1.5,
    float("inf"),
    float("nan"),
    "",
    "x" * 300,
    b"",
    bytes(32),
    bytes(300),
    [],
    {},
    [[]],
    {"": 0},
)


def mutated(decoder: Decoder, corpus: Sequence[bytes], rng: random.Random) -> bytes:
    """Return a new input made from those of a corpus."""
    data = rng.choice(corpus)
    if decoder.is_cbor and rng.random() < 0.6:
        data = _cbor(data, rng)
    for _ in range(rng.choice((0, 1, 1, 1, 2, 3, 6)) if decoder.is_cbor else rng.choice((1, 1, 1, 2, 3, 6))):
        data = rng.choice(_MUTATIONS)(data, corpus, decoder, rng)
    return data[: decoder.size_max]


def _flip(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    if not data:
        return bytes([rng.randrange(256)])
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    """Put a number of interest somewhere, in either byte order."""
    size = rng.choice((1, 2, 4, 8))
    number = (rng.choice(_NUMBERS) & ((1 << 8 * size) - 1)).to_bytes(size, rng.choice(("big", "little")))
    at = rng.randrange(len(data) + 1)
    return data[:at] + number + data[at + size :]


def _insert(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    word = rng.choice(decoder.tokens) if decoder.tokens and rng.random() < 0.8 else rng.randbytes(rng.randint(1, 9))
    return data[:at] + word * rng.choice((1, 1, 1, 2, 100)) + data[at:]


def _cut(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.randint(1, 16) :]


def _repeat(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    piece = data[at : at + rng.randint(1, 64)]
    return data[:at] + piece * rng.choice((2, 3, 50)) + data[at + len(piece) :]


def _splice(data: bytes, corpus: Sequence[bytes], decoder: Decoder, rng: random.Random) -> bytes:
    other = rng.choice(corpus)
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


_MUTATIONS: tuple[Callable[[bytes, Sequence[bytes], Decoder, random.Random], bytes], ...] = (
    _flip,
    _overwrite,
    _insert,
    _cut,
    _remove,
    _repeat,
    _splice,
)


_ITEMS_MAX: Final = 20_000  # tags 28 and 29 share values, so a few bytes can stand for more items than memory holds


def _cbor(data: bytes, rng: random.Random) -> bytes:
    """Return CBOR in which values were changed; bytes that are no CBOR come back as they are."""
    try:
        value = cbor2.loads(data)
        for _ in range(rng.choice((1, 1, 2, 3))):
            value = _changed(value, rng)
        # not canonical: that encoder of cbor2 does not end for some values; keys keep their order anyway
        return data if _items(value, _ITEMS_MAX) > _ITEMS_MAX else cbor2.dumps(value)
    except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, cbor2.CBORError):
        return data


def _items(value: Any, most: int) -> int:
    """Count the items of a value, those of shared parts each time, until there are more than ``most``."""
    count, left = 0, [value]
    while left and count <= most:
        each = left.pop()
        count += 1
        if isinstance(each, dict):
            left += [*each, *each.values()]
        elif isinstance(each, list | tuple | set | frozenset):
            left += each
    return count


def _changed(value: Any, rng: random.Random) -> Any:
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.1:
            return {each: inner for each, inner in value.items() if each != key}
        return {each: _changed(inner, rng) if each == key else inner for each, inner in value.items()}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = rng.randrange(len(value))
        if rng.random() < 0.2:
            return value * rng.choice((0, 2, 50))
        return [*value[:at], _changed(value[at], rng), *value[at + 1 :]]
    if isinstance(value, bytes) and value and rng.random() < 0.5:
        at = rng.randrange(len(value))
        return value[:at] + rng.randbytes(1) + value[at + rng.randint(0, 2) :]
    if isinstance(value, int) and rng.random() < 0.5:
        return value + rng.choice((-1, 1, 256, 1 << 32))
    return rng.choice(_VALUES)
