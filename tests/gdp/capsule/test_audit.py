"""Audit: each drawn damage is named with its record, and an undamaged capsule has none."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from gdp.capsule.audit import Audit, Damage, Finding
from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.record import Record, RecordType
from tests.draws import TIMES
from tests.gdp.capsule.log import NAME, Log
from tests.gdp.message.sealed import WRITER, seal

DRAWN = 200 * TIMES  # of each of the five kinds

Drawn = tuple[list[bytes], int]  # records, and the number of the damaged one


def audit(wires: list[bytes], *, known: bytes | None = None, is_deep: bool = False) -> list[Finding]:
    found = Audit(NAME, WRITER.public, known=known, is_deep=is_deep)
    found.add(b"".join(wires))
    return found.finish()


def flipped(wires: list[bytes], rng: random.Random) -> Drawn:
    at = rng.randrange(len(wires))
    altered = bytearray(wires[at])
    altered[rng.randrange(len(altered))] ^= 1 << rng.randrange(8)
    return [*wires[:at], bytes(altered), *wires[at + 1 :]], at


def forged(wires: list[bytes], rng: random.Random) -> Drawn:
    """Another content with a right checksum, as a holder could write it."""
    at = rng.randrange(len(wires))
    record = Record.from_wire(wires[at])
    body = bytearray(record.body)
    body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
    return [*wires[:at], record._replace(body=bytes(body)).to_wire(), *wires[at + 1 :]], at


def removed(wires: list[bytes], rng: random.Random) -> Drawn:
    at = rng.randrange(len(wires) - 1)  # without the last one the capsule is shorter, and nothing else
    return [*wires[:at], *wires[at + 1 :]], at


def reordered(wires: list[bytes], rng: random.Random) -> Drawn:
    begin, to = sorted(rng.sample(range(len(wires)), 2))
    order = [*wires[:begin], *wires[begin + 1 : to + 1], wires[begin], *wires[to + 1 :]]
    return order, begin


def duplicated(wires: list[bytes], rng: random.Random) -> Drawn:
    at = rng.randrange(len(wires))
    to = min(at + rng.randrange(1, 8), len(wires))
    return [*wires[:to], wires[at], *wires[to:]], at


def forked(wires: list[bytes], rng: random.Random) -> Drawn:
    at = rng.choice([at for at, wire in enumerate(wires) if Record.from_wire(wire).type is RecordType.MESSAGE])
    record = Record.from_wire(wires[at])
    chain = Chain(NAME, WRITER.public)
    for wire in wires[:at]:
        chain.handle_record(wire)
    frames = seal(record.sequence, b"another one", signer=WRITER)
    other = ChainWriter(chain, WRITER).append(record.type, record.time_ns, frames, record.sequence, 1)
    to = at + rng.randrange(2)
    return [*wires[:to], other, *wires[to:]], at


@pytest.mark.parametrize(
    ("draw", "kinds"),
    [
        (flipped, {Damage.ALTERED}),
        (forged, {Damage.ALTERED}),
        (removed, {Damage.REMOVED}),
        (reordered, {Damage.REORDERED}),
        (duplicated, {Damage.DUPLICATED}),
        (forked, {Damage.FORKED}),
    ],
)
def test_each_drawn_damage_is_named(draw: Callable[[list[bytes], random.Random], Drawn], kinds: set[Damage]) -> None:
    wires = Log().add(40).closed().wires
    rng = random.Random(7)
    for _ in range(DRAWN):
        damaged, number = draw(wires, rng)
        found = audit(damaged)
        assert any(each.damage in kinds and each.first <= number <= each.last for each in found), (number, found)


def test_an_undamaged_capsule_has_no_finding() -> None:
    log = Log().add(40).closed()
    assert audit(log.wires, is_deep=True) == []
    assert audit(log.wires, known=log.wires[-1]) == []


def test_segments_are_audited_one_after_the_other() -> None:
    wires = Log().add(40).closed().wires
    begins = [at for at, wire in enumerate(wires) if Record.from_wire(wire).type is RecordType.CHECKPOINT]
    found = Audit(NAME, WRITER.public)
    for begin, end in zip(begins, [*begins[1:], len(wires)], strict=True):
        found.add(b"".join(wires[begin:end]))
    assert found.finish() == []
    assert found.records == len(wires)


def test_a_capsule_that_begins_later_is_whole_from_there_on() -> None:
    wires = Log().add(40).closed().wires
    later = [Record.from_wire(wire).type for wire in wires].index(RecordType.CHECKPOINT, 1)
    assert audit(wires[later:]) == []


def test_a_capsule_that_ends_before_a_known_checkpoint_was_rolled_back() -> None:
    wires = Log().add(40).closed().wires
    (found,) = audit(wires[:20], known=wires[-1])
    assert (found.damage, found.last) == (Damage.ROLLED_BACK, len(wires) - 1)


def test_another_history_than_the_known_one_is_a_fork() -> None:
    one, two = Log().add(40).closed(), Log().add(40).closed()
    assert any(each.damage is Damage.FORKED for each in audit(one.wires, known=two.wires[-1]))


def test_messages_behind_the_last_checkpoint_are_verified_one_by_one() -> None:
    wires = Log().add(4).wires
    record = Record.from_wire(wires[-1])
    altered = record._replace(body=record.body[:-1] + bytes([record.body[-1] ^ 1])).to_wire()
    assert audit([*wires[:-1], altered]) == []
    (found,) = audit([*wires[:-1], altered], is_deep=True)
    assert (found.damage, found.first) == (Damage.ALTERED, record.number)
