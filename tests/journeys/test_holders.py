"""Several holders of a capsule: one copy on the uplink, equal whatever happens, and who lies is named."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.record import RecordType
from gdp.stores.capsule_store import StoreLimits, stored
from tests.draws import TIMES
from tests.journeys.capsules import LIMITS, Holder, Keeping, opened, records_at
from tests.journeys.flows import ROBOT, Tap, advertise, row

NAMES = "/store-a", "/store-b", "/store-c"
PLACES = "nuc1/holder", "nuc2/holder", "nuc5/holder"  # of two domains


def keeping_at(
    tmp_path: Path,
    count: int,
    limits: StoreLimits = LIMITS,
    most_bytes: int = 1 << 24,
    around_ns: tuple[int, int] | None = None,
    lease_s: float = 6.0,
) -> tuple[Keeping, list[Holder]]:
    """Return a robot that keeps a topic with some holders."""
    world, names = row(lease_s=lease_s), NAMES[:count]
    for place in PLACES[:count]:
        world.add_member(place, place.partition("/")[0])
    assert world.run_until_attached()
    keeping = Keeping(advertise(world), tmp_path / "robot", most_bytes, names, around_ns)
    holders = [
        Holder(world, tmp_path / place[:4], place, limits, name, tuple(each for each in names if each != name))
        for name, place in zip(names, PLACES, strict=False)
    ]
    return keeping, holders


def are_equal(keeping: Keeping, holders: Sequence[Holder]) -> bool:
    """Return whether each holder has all bytes that are on the robot's disk."""
    name = keeping.kept.name
    first = records_at(holders[0].store, name)
    return len(first) == keeping.kept.ring.end and all(records_at(each.store, name) == first for each in holders[1:])


def have_all(keeping: Keeping, holders: Sequence[Holder]) -> bool:
    """Return whether each holder has as many bytes as the robot; one may have lost its disk after it confirmed."""
    ends = [capsule.segments.end for holder in holders for capsule in holder.store.capsules]
    return ends == [keeping.kept.ring.end] * len(holders)


def test_one_copy_goes_up_and_every_holder_confirms_its_own(tmp_path: Path) -> None:
    keeping, holders = keeping_at(tmp_path, 3, lease_s=2.5)
    tap = Tap(ROBOT, "nuc1")
    keeping.flow.world.network.taps.append(tap)
    sent = keeping.publish_at([0.05 * each for each in range(160)], lambda each: bytes(6_000) + b"%d" % each)
    keeping.run(8.2, *holders)
    assert keeping.run(30, *holders, until=keeping.is_uploaded)
    end = keeping.kept.ring.end
    assert keeping.kept.confirmed == (end, end, end)
    assert are_equal(keeping, holders)
    assert [each.message for each in opened(records_at(holders[2].store, keeping.kept.name), keeping)] == sent
    assert end < sum(map(len, tap.frames)) < 1.5 * end
    assert keeping.kept.poll_faults() == []
    assert [each.faults for each in holders] == [[], [], []]


@pytest.mark.parametrize("seed", range(3 * TIMES - 2))
def test_holders_are_equal_after_deaths_partitions_and_lost_disks(tmp_path: Path, seed: int) -> None:
    keeping, holders = keeping_at(tmp_path, 3)
    world, rng = keeping.flow.world, random.Random(seed)
    sent = keeping.publish_at([0.05 * each for each in range(320)], lambda each: bytes(1_000) + b"%d" % each)
    begun_s, keeping.step_s = world.network.now.mono_s, 0.04
    for _ in range(6):
        keeping.run(rng.uniform(1, 3), *holders)
        which, what = rng.choice(holders), rng.choice(["dies", "loses its disk", "is apart", "has no uplink"])
        if what in ("dies", "loses its disk"):
            which.restart(has_disk=what == "dies")
            continue
        lead = world.leads[which.label if what == "is apart" else ROBOT]
        world.network.set_link(lead, up=False)
        keeping.run(rng.uniform(1, 6), *holders)
        world.network.set_link(lead, up=True)
    keeping.run(max(16.2 - (keeping.flow.world.network.now.mono_s - begun_s), 0), *holders)
    assert keeping.run(180, *holders, until=lambda: keeping.is_uploaded() and have_all(keeping, holders))
    assert are_equal(keeping, holders)
    assert [each.message for each in opened(records_at(holders[0].store, keeping.kept.name), keeping)] == sent
    for place in PLACES:
        (capsule,) = stored(tmp_path / place[:4])
        assert capsule.audit(is_deep=True).findings == []
    assert [each.faults for each in holders] == [[], [], []]


def test_any_one_holder_is_enough_and_one_that_was_away_catches_up(tmp_path: Path) -> None:
    keeping, (first, second) = keeping_at(tmp_path, 2)
    network, lead = keeping.flow.world.network, keeping.flow.world.leads[first.label]
    sent = keeping.publish_at([0.1 * each for each in range(240)], lambda each: bytes(3_000) + b"%d" % each)
    keeping.run(6, first, second)
    network.set_link(lead, up=False)
    keeping.run(19, first, second)
    assert keeping.run(40, first, second, until=lambda: keeping.kept.confirmed[1] == keeping.kept.ring.end)
    assert keeping.kept.confirmed[0] < keeping.kept.confirmed[1]
    assert any(each.startswith("1 of 2 holders have it") for each in keeping.kept.poll_faults())
    assert [each.message for each in opened(records_at(second.store, keeping.kept.name), keeping)] == sent
    tap = Tap(ROBOT, "nuc1")
    network.taps.append(tap)
    network.set_link(lead, up=True)
    assert keeping.run(90, first, second, until=keeping.is_uploaded)
    assert are_equal(keeping, [first, second])
    assert sum(map(len, tap.frames)) < 0.5 * keeping.kept.ring.end


def test_windows_around_events_are_the_same_at_every_holder(tmp_path: Path) -> None:
    """What stands between two windows is a gap, which is no damage, and which no exchange stops at."""
    keeping, holders = keeping_at(tmp_path, 2, around_ns=(1_000_000_000, 1_000_000_000))
    network = keeping.flow.world.network

    def mark() -> None:
        keeping.kept.mark("/estop", int(network.now.unix_s * 1e9))

    sent = keeping.publish_at([0.05 * each for each in range(400)], lambda each: bytes(1_000) + b"%d" % each)
    for at_s in (3.0, 9.0, 9.5, 16.0):
        network.call(at_s, mark)
    network.set_link(keeping.flow.world.leads[holders[1].label], up=False)
    keeping.run(12, *holders)
    network.set_link(keeping.flow.world.leads[holders[1].label], up=True)
    keeping.run(10, *holders)
    assert keeping.run(60, *holders, until=keeping.is_uploaded)
    first, second = (records_at(each.store, keeping.kept.name) for each in holders)
    assert first == second
    held = [each.message for each in opened(first, keeping)]
    assert 3 * 40 <= len(held) < 260
    assert set(held) < set(sent)
    for place in PLACES[:2]:
        (capsule,) = stored(tmp_path / place[:4])
        assert capsule.audit(is_deep=True).findings == []
    assert [each.faults for each in holders] == [[], []]


def test_what_one_holder_alone_has_fills_the_gap_of_another(tmp_path: Path) -> None:
    """The robot's ring dropped what only a holder that died had."""
    keeping, (first, second) = keeping_at(tmp_path, 2, most_bytes=200_000, lease_s=2.5)
    network, leads = keeping.flow.world.network, keeping.flow.world.leads
    sent = keeping.publish_at([0.05 * each for each in range(300)], lambda each: bytes(3_000) + b"%d" % each)
    network.set_link(leads[second.label], up=False)
    keeping.run(4, first, second)
    network.set_link(leads[first.label], up=False)
    network.set_link(leads[second.label], up=True)
    keeping.run(12, first, second)
    assert keeping.run(60, first, second, until=lambda: keeping.kept.confirmed[1] == keeping.kept.ring.end)
    alone = opened(records_at(second.store, keeping.kept.name), keeping)
    network.set_link(leads[first.label], up=True)
    keeping.run(60, first, second)
    whole = [opened(records_at(each.store, keeping.kept.name), keeping) for each in (first, second)]
    assert whole[0] == whole[1]
    assert len(alone) < len(whole[0]) <= len(sent)
    assert {each.message for each in alone} < {each.message for each in whole[0]}
    assert any("is repaired from /store-a" in each for each in second.faults)


def test_a_writer_that_forks_is_found_by_the_exchange_and_named(tmp_path: Path) -> None:
    keeping, (first, second) = keeping_at(tmp_path, 2)
    keeping.publish_at([0.1 * each for each in range(60)], lambda each: b"%d" % each)
    keeping.run(6.5, first, second)
    assert keeping.run(20, first, second, until=keeping.is_uploaded)
    descriptor, identities = keeping.kept.ring.descriptor, keeping.flow.world.identities.values()
    identity = next(each for each in identities if each.name == keeping.flow.member.name)
    second.restart(has_disk=False)
    forked = ChainWriter(Chain(descriptor.name, descriptor.key), identity.key)
    wires = [forked.checkpoint(0)]
    for at in range(3):
        wires += [forked.append(RecordType.MESSAGE, at, [b"another"], at + 1, 1), forked.checkpoint(at)]
    capsule = second.store.adopt(descriptor)
    assert second.store.add(capsule, 0, b"".join(wires))
    keeping.run(20, first, second)
    words = [each for each in second.faults if "record 0 forked" in each]
    assert words
    assert identity.name.to_text() in words[0]
    assert NAMES[0] in words[0]
