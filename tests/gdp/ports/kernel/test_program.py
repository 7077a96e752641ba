"""Forwarder program, compared with ``decide`` and ``rewrite`` by ``BPF_PROG_TEST_RUN``, without traffic or devices.

The kernel lets a test frame come in on the loopback device, whose address is zero. The frames here are therefore
addressed to zero, on which no decision depends. Entries with several hops are tested on real devices, because the
program sends the copies itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gdp.errors import DropReason
from gdp.frame.codec import (
    DESTINATION_AT,
    ETHER_BYTES,
    HEADER_BYTES,
    HOPS_AT,
    SECOND_PATH,
    SOURCE_AT,
    Flag,
    Kind,
    second_path_key,
)
from gdp.ports.kernel import syscall
from gdp.ports.kernel.assembler import Assembler, Reg
from gdp.ports.kernel.loaded_program import LoadedProgram
from gdp.ports.kernel.map_sync import MapSync
from gdp.ports.kernel.program import DROP, REDIRECT, UP
from gdp.ports.kernel.syscall import LoadRefusedError
from gdp.switch.forwarder import Drop, Forward, Punt, decide, rewrite
from gdp.switch.table import NOWHERE, Hops, Paces, Table, sides_of
from tests.fixtures_forwarding import (
    ANYBODY,
    CASES,
    ENTRIES,
    GONE,
    MTUS,
    ONE,
    OTHER_SOURCE,
    SOURCE,
    SPLIT,
    TO_ABSENT,
    TO_NARROW,
    TO_WIDE,
    Case,
    frame,
)

TO_US = bytes(6)  # the loopback's address
LEFT_TO_PYTHON = {DropReason.TRUNCATED, DropReason.BAD_ETHERTYPE, DropReason.BAD_VERSION, DropReason.HOPS_EXPIRED}
LEFT_TO_PYTHON |= {DropReason.TOO_BIG, DropReason.NO_SECOND_PATH}
DESTINATION = slice(ETHER_BYTES + DESTINATION_AT, ETHER_BYTES + SOURCE_AT)  # left to Python with an entry for no source
UNKNOWN_PORT = 9  # a port that the kernel does not know
TO_UNKNOWN_PORT = (UNKNOWN_PORT, bytes(12))


@dataclass(frozen=True)
class Step:
    """Action of the program on one frame, and its counters."""

    retval: int
    frame: bytes
    drops: dict[DropReason, int]
    taken: int
    copies: int


def paces_of(entries: Mapping[bytes, Hops]) -> dict[bytes, Paces]:
    """Return paces of the hops of entries for one source, as only trees have them."""
    return {key: (100,) * len(entries[key]) for key in entries if key.endswith(SOURCE) and len(key) > len(SOURCE)}


def forwards(loaded: LoadedProgram, entries: Mapping[bytes, Hops], mtus: Mapping[int, int] = MTUS) -> Table:
    """Set the program's entries; ports have no device, because nothing is sent here."""
    table = Table()
    for port in range(UNKNOWN_PORT):
        loaded.set_port(port, 1 if port in mtus else 0, mtus.get(port, 0), 0)
    for key in list(entries):
        table.install(key, entries[key], 1.0, paces=paces_of(entries).get(key, ()))
    table.observe(MapSync(table, *loaded.of_entries))
    return table


def clear(table: Table) -> None:
    table.expire(1.0)
    table.observe(None)


def destination_of(given: bytes) -> bytes:
    """Return the destination by which a frame is looked up."""
    is_second = given[ETHER_BYTES + HOPS_AT] & SECOND_PATH
    return second_path_key(given[DESTINATION]) if is_second else given[DESTINATION]


def step(loaded: LoadedProgram, given: bytes) -> Step:
    before = loaded.counters()
    run = syscall.run(loaded.program_of(0), given)
    after = loaded.counters()
    drops = {reason: after.drops[reason] - before.drops[reason] for reason in DropReason}
    return Step(
        run.retval,
        run.frame,
        {reason: count for reason, count in drops.items() if count},
        after.frames_in - before.frames_in,
        after.forwarded - before.forwarded,
    )


def check(done: Step, given: bytes, entries: Mapping[bytes, Hops]) -> None:
    """Check that the program did the same as ``decide`` and ``rewrite``, or punted for a permitted reason."""
    said = decide(given, entries, MTUS, paces=paces_of(entries))
    if done.retval == UP:
        reasons = {said.reason} if isinstance(said, Drop) else set(said.lost) if isinstance(said, Forward) else set()
        assert isinstance(said, Punt) or reasons & LEFT_TO_PYTHON or destination_of(given) + bytes(32) in entries
        assert (done.frame, done.drops, done.taken, done.copies) == (given, {}, 0, 0)
    elif done.retval == DROP:
        lost = (said.reason,) if isinstance(said, Drop) else said.lost if isinstance(said, Forward) else ()
        assert not isinstance(said, Forward) or not said.hops
        assert done.drops == {lost[0]: 1}
        assert (done.taken, done.copies) == (1, 0)
    else:
        assert done.retval == REDIRECT
        assert isinstance(said, Forward)
        ((_, macs),) = said.hops
        assert done.frame == rewrite(given, macs)
        assert (done.drops, done.taken, done.copies) == ({}, 1, 1)


SINGLE = {key: hops for key, hops in ENTRIES.items() if len(hops) < 2}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_each_fixture_of_one_hop_becomes_what_the_reference_says(case: Case, loaded: LoadedProgram) -> None:
    given = TO_US + case.frame[6:]
    table = forwards(loaded, SINGLE)
    try:
        check(step(loaded, given), given, SINGLE)
    finally:
        clear(table)


def test_the_ordinary_is_not_left_to_python(loaded: LoadedProgram) -> None:
    table = forwards(loaded, SINGLE)
    try:
        retvals = [
            step(loaded, TO_US + each[6:]).retval
            for each in (frame(ONE), frame(SPLIT, source=OTHER_SOURCE), frame(GONE, source=OTHER_SOURCE))
        ]
    finally:
        clear(table)
    assert retvals == [REDIRECT, REDIRECT, DROP]


def test_a_second_copy_takes_the_entry_of_the_second_path_and_keeps_its_bit(loaded: LoadedProgram) -> None:
    given = TO_US + frame(ONE, hops_left=SECOND_PATH | 64)[6:]
    table = forwards(loaded, {ONE: (TO_WIDE,), second_path_key(ONE) + SOURCE: (TO_NARROW,)})
    try:
        done = step(loaded, given)
    finally:
        clear(table)
    assert (done.retval, done.taken, done.copies) == (REDIRECT, 1, 1)
    assert done.frame[:12] == TO_NARROW[1]
    assert done.frame[ETHER_BYTES + HOPS_AT] == SECOND_PATH | 63


NAMES = st.sampled_from([ONE, SPLIT, GONE, ANYBODY])
KEYS = NAMES | NAMES.map(second_path_key)
SOURCES = st.sampled_from([SOURCE, OTHER_SOURCE, bytes(32)])
HOPS = st.sampled_from([NOWHERE, (TO_WIDE,), (TO_NARROW,), (TO_ABSENT,), (TO_UNKNOWN_PORT,)])
TABLES = st.dictionaries(KEYS | st.builds(bytes.__add__, KEYS, SOURCES), HOPS, max_size=8)
NEAR = st.integers(-3, 3)


@st.composite
def frames(draw: st.DrawFn) -> bytes:
    """Frames near every bound on which a decision depends."""
    size = draw(st.sampled_from([0, 1, 600, MTUS[2] - HEADER_BYTES, MTUS[1] - HEADER_BYTES])) + draw(NEAR)
    payload = bytes(max(size, 0))
    whole = frame(
        draw(NAMES),
        payload,
        source=draw(SOURCES),
        kind=draw(st.sampled_from([Kind.DATA, 0x7F, 0x80, 0xFF])),
        flags=draw(st.integers(0, 255)),
        hops_left=draw(st.sampled_from([0, 1, 2, 64, 127, 128, 129, 130, 192, 255])),
        length=draw(st.none() | st.just(max(len(payload) + draw(NEAR), 0))),
        padding=bytes(draw(st.integers(0, 3))),
        pace=draw(st.sampled_from([0, 99, 100, 101, 255])),
    )
    changes = draw(st.lists(st.tuples(st.integers(12, 20), st.integers(0, 255)), max_size=1))
    changed = bytearray(TO_US + whole[6:])
    for at, value in changes:
        changed[at] = value
    return bytes(changed[: draw(st.sampled_from([len(changed)] * 6 + [ETHER_BYTES, 60, 109]))])


@settings(deadline=None)
@given(given=st.lists(frames(), min_size=1, max_size=8), entries=TABLES)
def test_generated_frames_and_tables_get_the_decision_of_the_reference(
    loaded: LoadedProgram, given: list[bytes], entries: dict[bytes, Hops]
) -> None:
    table = forwards(loaded, entries)
    try:
        for each in given:
            check(step(loaded, each), each, entries)
    finally:
        clear(table)


@pytest.mark.parametrize("hops", [(TO_WIDE,), NOWHERE])
def test_what_comes_from_a_side_where_its_publisher_is_not_is_dropped_there(loaded: LoadedProgram, hops: Hops) -> None:
    given = TO_US + frame(ONE)[6:]
    key = given[ETHER_BYTES + DESTINATION_AT : ETHER_BYTES + HEADER_BYTES]
    table = forwards(loaded, {})
    try:
        for ports in ((0,), (2, 62), (63,), (63, 400)):
            table.install(key, hops, 1.0, sides_of(ports))
            for port in (0, 1, 2, 40, 62, 63, 64, 400, 999):
                said = decide(given, table.entries, MTUS, table.sides, port)
                before = loaded.counters()
                run = syscall.run(loaded.program_of(port), given)
                after = loaded.counters()
                lost = after.drops[DropReason.WRONG_SIDE] - before.drops[DropReason.WRONG_SIDE]
                is_ours = port in ports or (port > 63 and 63 in ports) or (port == 63 and max(ports) > 63)
                assert (lost == 0) == is_ours
                assert (said == Drop(DropReason.WRONG_SIDE)) != is_ours
                assert is_ours or run.retval == DROP
        table.install(key, hops, 1.0)
        assert loaded.counters().drops[DropReason.WRONG_SIDE] == after.drops[DropReason.WRONG_SIDE]
        syscall.run(loaded.program_of(1), given)
        assert loaded.counters().drops[DropReason.WRONG_SIDE] == after.drops[DropReason.WRONG_SIDE]
    finally:
        clear(table)


def test_only_what_is_urgent_gets_a_priority(loaded: LoadedProgram) -> None:
    table = forwards(loaded, SINGLE)
    try:
        plain = syscall.run(loaded.program_of(0), TO_US + frame(ONE)[6:])
        urgent = syscall.run(loaded.program_of(0), TO_US + frame(ONE, flags=Flag.URGENT)[6:])
    finally:
        clear(table)
    assert (plain.retval, plain.priority) == (REDIRECT, 0)
    assert (urgent.retval, urgent.priority) == (REDIRECT, 6)


def test_what_another_station_should_get_is_left_alone(loaded: LoadedProgram) -> None:
    table = forwards(loaded, SINGLE)
    try:
        assert step(loaded, bytes([2, 0, 0, 0, 0, 9]) + frame(ONE)[6:]).retval == UP
        assert step(loaded, b"\xff" * 6 + frame(ONE)[6:]).retval == UP
    finally:
        clear(table)


def test_a_lease_that_ended_leaves_everything_to_python(loaded: LoadedProgram) -> None:
    table = forwards(loaded, SINGLE)
    given = TO_US + frame(ONE)[6:]
    try:
        loaded.renew(-1)
        assert step(loaded, given).retval == (UP if loaded.is_leased else REDIRECT)
        loaded.renew(3_600)
        assert step(loaded, given).retval == REDIRECT
    finally:
        clear(table)


def test_a_refused_program_says_why_in_the_words_of_the_verifier(loaded: LoadedProgram) -> None:
    bad = Assembler()
    bad.load(Reg.R0, Reg.R5, 0, 8)
    bad.leave()
    with pytest.raises(LoadRefusedError) as refused:
        syscall.load_program(bad.assemble(), "gdp_bad", b"Apache-2.0")
    assert "R5 !read_ok" in refused.value.log
    assert refused.value.log in str(refused.value)


def test_an_unknown_machine_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "pdp11")
    with pytest.raises(Exception, match="pdp11"):
        LoadedProgram(1)
