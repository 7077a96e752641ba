"""Decoder to fuzz: a function of bytes, its permitted errors, and its expected inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Decoder"]


@dataclass(frozen=True, slots=True)
class Decoder:
    """One decoder.

    Args:
        name: of its folder in the corpus too.
        run: decodes bytes; what it returns does not matter.
        seeds: inputs to begin with, at least one of which is taken.
        allowed: the exceptions by which it refuses.
        tokens: words that mean something in its inputs.
        is_cbor: inputs are one item of CBOR, and are mutated as such too.
        size_max: longest input, in bytes.
        time_max_ms: processor time that an input may take.
        memory_max: most bytes held at a time, over the length of an input of 64 KiB, or a proportion of that.
    """

    name: str
    run: Callable[[bytes], object]
    seeds: tuple[bytes, ...]
    allowed: tuple[type[BaseException], ...]
    tokens: tuple[bytes, ...] = ()
    is_cbor: bool = False
    size_max: int = 64 << 10
    time_max_ms: float = 50.0
    memory_max: float = 4.0
