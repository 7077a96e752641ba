"""Forwarding table: leases, observers, and bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from gdp.errors import LocalError
from gdp.names import Name
from gdp.switch.table import NOWHERE, Hops, Table

HOPS: Hops = ((1, b"m" * 12),)


def key(number: int, size: int = 32) -> bytes:
    return number.to_bytes(size, "big")


def test_an_entry_stands_until_its_lease_ends() -> None:
    table = Table()
    table.install(key(1), HOPS, 10.0)
    assert table.expire(9.9) == []
    assert table.entries[key(1)] == HOPS
    assert table.expire(10.0) == [key(1)]
    assert key(1) not in table.entries


def test_a_renewed_lease_counts_from_the_new_end() -> None:
    table = Table()
    table.install(key(1), HOPS, 10.0)
    table.install(key(1), HOPS, 20.0)
    assert table.next_expiry() == 20.0
    assert table.expire(19.0) == []
    assert table.expire(20.0) == [key(1)]


def test_a_shortened_lease_ends_sooner() -> None:
    table = Table()
    table.install(key(1), HOPS, 20.0)
    table.install(key(1), HOPS, 10.0)
    assert table.next_expiry() == 10.0
    assert table.expire(10.0) == [key(1)]
    assert table.expire(20.0) == []


def test_expired_keys_come_earliest_first() -> None:
    table = Table()
    for number, end in ((1, 3.0), (2, 1.0), (3, 2.0)):
        table.install(key(number), HOPS, end)
    assert table.expire(5.0) == [key(2), key(3), key(1)]


def test_an_empty_table_expects_nothing() -> None:
    table = Table()
    table.install(key(1), HOPS, 1.0)
    table.remove(key(1))
    assert table.next_expiry() is None
    assert len(table) == 0


def test_removing_what_is_not_there_says_so() -> None:
    table = Table()
    table.install(key(1), HOPS, 1.0)
    assert table.remove(key(1))
    assert not table.remove(key(1))


def test_a_removed_negative_entry_was_there() -> None:
    table = Table()
    table.install(key(1), NOWHERE, 1.0)
    assert table.entries[key(1)] == ()
    assert table.remove(key(1))


def test_a_full_table_takes_no_new_key_but_renews_the_old() -> None:
    table = Table(max_entries=2)
    assert table.install(key(1), HOPS, 1.0)
    assert table.install(key(2), HOPS, 1.0)
    assert not table.install(key(3), HOPS, 1.0)
    assert table.install(key(2), NOWHERE, 2.0)
    assert len(table) == 2


def test_equal_hops_are_one_object() -> None:
    table = Table()
    table.install(key(1), ((1, bytes([7]) * 12),), 1.0)
    table.install(key(2), ((1, bytes([7]) * 12),), 1.0)
    assert table.entries[key(1)] is table.entries[key(2)]


def test_a_slice_of_a_frame_finds_an_entry_installed_by_name() -> None:
    table = Table()
    table.install(Name(key(1)), HOPS, 1.0)
    assert table.entries[bytes(memoryview(bytearray(40) + key(1))[40:])] == HOPS
    assert all(type(k) is bytes for k in table.entries)


@pytest.mark.parametrize("wrong", [b"", key(1, 31), key(1, 33), key(1, 65)])
def test_a_key_of_another_length_is_our_own_fault(wrong: bytes) -> None:
    with pytest.raises(LocalError):
        Table().install(wrong, HOPS, 1.0)


def test_a_hop_without_both_addresses_is_our_own_fault() -> None:
    with pytest.raises(LocalError):
        Table().install(key(1), ((1, b"m" * 6),), 1.0)


@given(st.lists(st.tuples(st.booleans(), st.floats(1, 100)), max_size=200))
def test_what_was_taken_back_leaves_no_lasting_trace(changes: list[tuple[bool, float]]) -> None:
    table = Table()
    for _ in range(20):
        for keep, end in changes:
            table.install(key(1), HOPS, end)
            if not keep:
                table.remove(key(1))
    assert len(table._heap) <= 2 * len(table) + 1_024 + 1


class Copy:
    """Observer that keeps a copy, and refuses changes that change nothing."""

    def __init__(self) -> None:
        self.entries: dict[bytes, Hops] = {}

    def put(self, items: Mapping[bytes, Hops]) -> None:
        for each, hops in items.items():
            assert self.entries.get(each) != hops
            self.entries[each] = hops

    def remove(self, keys: Sequence[bytes]) -> None:
        for each in keys:
            del self.entries[each]


def test_an_observer_hears_of_what_was_there_before_it() -> None:
    table, copy = Table(), Copy()
    table.install(key(1), HOPS, 1.0)
    table.observe(copy)
    assert copy.entries == {key(1): HOPS}


def test_an_observer_that_was_sent_away_hears_no_more() -> None:
    table, copy = Table(), Copy()
    table.observe(copy)
    table.observe(None)
    table.install(key(1), HOPS, 1.0)
    assert copy.entries == {}


def test_new_entries_are_taken_until_the_table_is_full() -> None:
    table = Table(max_entries=3)
    table.install(key(9), HOPS, 5.0)
    assert [table.install(key(n), HOPS, 2.0) for n in (1, 9, 2, 3, 4)] == [True, True, True, False, False]
    assert table.entries.keys() == {key(9), key(1), key(2)}
    assert set(table.expire(2.0)) == {key(9), key(1), key(2)}


class TableAgainstPlainDict(RuleBasedStateMachine):
    """Compare the table with a dictionary and a scan."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self.model, self.copy = Table(max_entries=6), dict[bytes, float](), Copy()
        self.table.observe(self.copy)
        self.now_s = 0.0

    @rule(number=st.integers(0, 8), lease_s=st.integers(0, 20), to=st.sampled_from([HOPS, NOWHERE]))
    def install(self, number: int, lease_s: int, to: Hops) -> None:
        taken = self.table.install(key(number), to, self.now_s + lease_s)
        assert taken == (key(number) in self.model or len(self.model) < 6)
        if taken:
            self.model[key(number)] = self.now_s + lease_s

    @rule(number=st.integers(0, 8))
    def remove(self, number: int) -> None:
        assert self.table.remove(key(number)) == (self.model.pop(key(number), None) is not None)

    @rule(pass_s=st.integers(0, 10))
    def expire(self, pass_s: int) -> None:
        self.now_s += pass_s
        gone = {k for k, end in self.model.items() if end <= self.now_s}
        assert set(self.table.expire(self.now_s)) == gone
        for k in gone:
            del self.model[k]

    @invariant()
    def same(self) -> None:
        assert self.table.entries.keys() == self.model.keys()
        assert self.table.entries == self.copy.entries
        assert self.table.next_expiry() == min(self.model.values(), default=None)


TestTableAgainstPlainDict = TableAgainstPlainDict.TestCase
