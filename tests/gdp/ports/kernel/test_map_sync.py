"""Kernel's map, compared with the table after any changes."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gdp.ports.kernel.abi import BRANCHES_MAX, GROUP, NOWHERE_PORT, PORTS_MAX, EntryAt, group
from gdp.ports.kernel.loaded_program import LoadedProgram
from gdp.ports.kernel.map_sync import MapSync
from gdp.switch.table import NOWHERE, Hops, Table

ONE_HOP: Hops = ((1, b"m" * 12),)
PROTECTED: Hops = ((1, b"m" * 12, 2, b"n" * 12),)
PAIR: Hops = ((1, b"m" * 12), (2, b"n" * 12))
TRIPLE: Hops = (*PAIR, (3, b"o" * 12))
GUARDED: Hops = (*PAIR, (3, b"o" * 12, 1, b"m" * 12))
WIDE: Hops = tuple((port, b"w" * 12) for port in range(BRANCHES_MAX + 1))
FAR: Hops = ((PORTS_MAX, b"f" * 12),)


def name(number: int) -> bytes:
    return bytes([number]) * 32


def in_kernel(loaded: LoadedProgram, key: bytes) -> Hops | None:
    """Return the value that the program would find for a key."""
    value = loaded.entries.get(key.ljust(64, b"\0"))
    if value is None:
        return None

    def number(at: int) -> int:
        return int.from_bytes(value[at : at + 4], sys.byteorder)

    port = number(EntryAt.PORT)
    if port == NOWHERE_PORT:
        return NOWHERE
    if port != GROUP:
        macs, alternate = value[EntryAt.MACS : EntryAt.ALTERNATE], number(EntryAt.ALTERNATE)
        if alternate == NOWHERE_PORT:
            return ((port, macs),)
        return ((port, macs, alternate, value[EntryAt.ALTERNATE + EntryAt.MACS : EntryAt.GROUP]),)
    body = loaded.groups.get(value[EntryAt.GROUP : EntryAt.GROUP + 4])
    return next(hops for hops in (PAIR, TRIPLE, GUARDED) if group(hops) == body)


def watched(loaded: LoadedProgram) -> tuple[Table, MapSync]:
    table = Table()
    mirror = MapSync(table, *loaded.of_entries)
    table.observe(mirror)
    return table, mirror


def install_at_once(table: Table, mirror: MapSync, items: Sequence[tuple[bytes, Hops]]) -> None:
    """Add entries of which the mirror hears in one call."""
    table.observe(None)
    for key, hops in items:
        table.install(key, hops, 1.0)
    mirror.put({key: table.entries[key] for key, _ in items})
    table._observer = mirror  # ``observe`` would pass on the older entries, too


KEYS = st.builds(lambda a, b: name(a) + (name(b) if b else b""), st.integers(1, 3), st.integers(0, 3)) | st.builds(
    lambda a: name(a) + bytes(32), st.integers(1, 3)
)
CHANGES = st.lists(
    st.tuples(KEYS, st.sampled_from([None, NOWHERE, ONE_HOP, PROTECTED, PAIR, TRIPLE, GUARDED, WIDE, FAR])),
    min_size=1,
    max_size=20,
)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=CHANGES, at_once=st.booleans())
def test_the_kernel_has_what_the_table_has_or_nothing(
    small: LoadedProgram, changes: list[tuple[bytes, Hops | None]], at_once: bool
) -> None:
    table, mirror = watched(small)
    if at_once:
        install_at_once(table, mirror, [(key, hops) for key, hops in changes if hops is not None])
    for key, hops in changes:
        if hops is None:
            table.remove(key)
        elif not at_once:
            table.install(key, hops, 1.0)
    try:
        found = {key: in_kernel(small, key) for key in table.entries if key[32:] != bytes(32)}
        assert all(hops in (None, table.entries[key]) for key, hops in found.items())
        assert all(
            found.get(key) is None for key in table.entries if len(key) == 32 and key + bytes(32) in table.entries
        )
        held = [key for key, hops in found.items() if hops is not None]
        assert len(mirror) == len(held)
        assert mirror.left_out == len(table) - len(held)
        fit = [
            key
            for key, hops in table.entries.items()
            if hops not in (WIDE, FAR) and key[32:] != bytes(32) and key[:32] + bytes(32) not in table.entries
        ]
        assert len(held) >= min(3, len([key for key in fit if len(key) == 32]))
    finally:
        table.expire(1.0)
    assert len(mirror) == mirror.left_out == 0
    assert all(small.groups.get(n.to_bytes(4, sys.byteorder)) is None for n in range(8))


def test_a_counter_that_is_used_again_begins_at_zero(small: LoadedProgram) -> None:
    table, mirror = watched(small)
    for number in (1, 2, 3):
        table.install(name(number), ONE_HOP, 1.0)
    value = (7).to_bytes(8, sys.byteorder) * (small.counts.value_bytes // 8)
    for counter in (1, 2, 3):
        small.counts.put(counter.to_bytes(4, sys.byteorder), value)
    cpus = small.counts.value_bytes // 16
    assert mirror.counts(10) == dict.fromkeys(map(name, (1, 2, 3)), (7 * cpus, 7 * cpus))
    table.remove(name(2))
    table.install(name(4), ONE_HOP, 1.0)
    assert mirror.counts(10) == dict.fromkeys(map(name, (1, 3)), (7 * cpus, 7 * cpus))


@pytest.mark.parametrize("hops", [NOWHERE, PAIR])
def test_an_entry_that_changes_its_way_keeps_its_counts(small: LoadedProgram, hops: Hops) -> None:
    table, mirror = watched(small)
    table.install(name(1), ONE_HOP, 1.0)
    small.counts.put((1).to_bytes(4, sys.byteorder), (9).to_bytes(8, sys.byteorder) * (small.counts.value_bytes // 8))
    before = mirror.counts(1)
    table.install(name(1), hops, 1.0)
    assert in_kernel(small, name(1)) == hops
    assert mirror.counts(1) == before != {}


def test_a_full_map_is_not_retried_for_each_name(small: LoadedProgram, monkeypatch: pytest.MonkeyPatch) -> None:
    table, mirror = watched(small)
    held = [name(number) for number in (1, 2, 3)]
    install_at_once(table, mirror, [(key, ONE_HOP) for key in held])
    tried: list[bytes] = []
    put = small.entries.put

    def count(key: bytes, value: bytes) -> None:
        tried.append(key)
        put(key, value)

    monkeypatch.setattr(small.entries, "put", count)
    new = [name(number) for number in range(10, 60)]
    install_at_once(table, mirror, [(key, PAIR) for key in (*new, *held)])
    assert {key[:32] for key in tried} == {new[0], *held}
    assert [in_kernel(small, key) for key in held] == [PAIR] * 3
    assert all(in_kernel(small, key) is None for key in new)
    assert (len(mirror), mirror.left_out) == (3, 50)
    table.expire(1.0)
    assert len(mirror) == mirror.left_out == 0
    assert all(small.groups.get(n.to_bytes(4, sys.byteorder)) is None for n in range(8))
