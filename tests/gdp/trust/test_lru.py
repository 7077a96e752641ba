"""Bounded cache of positive verification results."""

from __future__ import annotations

from gdp.trust.lru import Lru


def test_the_least_used_is_forgotten_first() -> None:
    memory: Lru[int] = Lru(2)
    memory.put(b"a", 1)
    memory.put(b"b", 2)
    memory.get(b"a")
    memory.put(b"c", 3)
    assert (memory.get(b"a"), memory.get(b"b"), memory.get(b"c")) == (1, None, 3)


def test_it_never_holds_more_than_its_bound() -> None:
    memory: Lru[int] = Lru(3)
    for number in range(100):
        memory.put(bytes([number]), number)
    assert len(memory) == 3
