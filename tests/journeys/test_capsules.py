"""Capsules: the history of a topic reaches its holder whole, unreadable, and provably the writer's."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from gdp.capsule.audit import Audit, Damage
from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.holder import HolderAnswer, HolderRequest
from gdp.capsule.opening import CapsuleOpener
from gdp.capsule.record import Record, RecordType, split
from gdp.crypto.keys import SigningKey
from gdp.frame.codec import HOPS_AT
from gdp.stores.capsule_store import stored
from tests.journeys.capsules import Holder, Keeping, opened, read_from, records_at
from tests.journeys.flows import ROBOT, Tap, advertise, flowing, row


def holding(tmp_path: Path, *, reliable: bool = True, reader: str = "") -> tuple[Keeping, Holder]:
    world = row()
    if reader:
        world.add_member(reader, "nuc2")
        assert world.run_until_attached()
    flow = advertise(world, reliable=reliable) if not reader else flowing(world, readers=(reader,), reliable=reliable)
    return Keeping(flow, tmp_path / "robot"), Holder(world, tmp_path / "holder")


@pytest.mark.parametrize("reliable", [True, False])
def test_what_has_no_reader_is_kept(tmp_path: Path, reliable: bool) -> None:
    keeping, holder = holding(tmp_path, reliable=reliable)
    sent = keeping.publish_at([0.04 * each for each in range(200)], lambda each: b"%d" % each)
    keeping.run(8.2, holder)
    assert keeping.run(20, holder, until=keeping.is_uploaded)
    data = records_at(holder.store, keeping.kept.name)
    assert [each.message for each in opened(data, keeping)] == sent
    (capsule,) = stored(tmp_path / "holder")
    assert capsule.audit(is_deep=True).findings == []


@pytest.mark.parametrize(("reliable", "seed"), [(True, 1), (False, 3)])
def test_history_is_whole_while_the_uplink_is_gone_half_the_time(tmp_path: Path, reliable: bool, seed: int) -> None:
    keeping, holder = holding(tmp_path, reliable=reliable, reader="nuc2/edge")
    world, rng, at_s = keeping.flow.world, random.Random(seed), 0.0
    while at_s < 18:
        for is_up in (False, True):
            world.network.call(at_s, partial(world.network.set_link, world.leads[ROBOT], up=is_up))
            at_s += rng.uniform(0.3, 4.0)
    times_s = sorted(rng.uniform(0, 18) for _ in range(240))
    sent = keeping.publish_at(times_s, lambda each: each.to_bytes(4, "big") + rng.randbytes(rng.choice([20, 3_000])))
    keeping.run(at_s, holder)
    assert keeping.run(60, holder, until=keeping.is_uploaded)
    kept = opened(records_at(holder.store, keeping.kept.name), keeping)
    assert [each.message for each in kept] == sent
    assert [each.sequence for each in kept] == list(range(1, 241))
    assert keeping.kept.lost == 0
    (capsule,) = stored(tmp_path / "holder")
    assert capsule.audit(is_deep=True).findings == []


def test_a_late_reader_and_the_capsule_get_the_same_frames(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path, reader="nuc2/edge")
    tap = Tap("nuc1", "nuc2")
    keeping.flow.world.network.taps.append(tap)
    sent = keeping.publish_at([0.05 * each for each in range(160)], lambda each: bytes(2_000))
    keeping.run(9, holder, until=lambda: False)
    assert keeping.run(20, holder, until=keeping.is_uploaded)
    live = {each[HOPS_AT + 1 :] for each in tap.frames}
    data = records_at(holder.store, keeping.kept.name)
    records = [Record.from_wire(wire) for wire in split(data)]
    frames = [each for record in records if record.type is RecordType.MESSAGE for each in record.frames]
    assert len(frames) >= len(sent)
    assert all(each[HOPS_AT + 1 :] in live for each in frames)


def test_nothing_is_readable_at_the_holder_before_a_grant(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    text = b"the robot is in the laboratory"
    keeping.publish_at([0.2 * each for each in range(40)], lambda _: text)
    keeping.run(8.5, holder)
    assert keeping.run(20, holder, until=keeping.is_uploaded)
    files = [path.read_bytes() for path in (tmp_path / "holder").rglob("*") if path.is_file()]
    assert sum(map(len, files)) > 40 * len(text)
    known = (text, b"described", b"/chatter", b"nuc1/robot"[5:8] + b" is")
    assert not any(each in data for each in known for data in files)
    granted = opened(records_at(holder.store, keeping.kept.name), keeping)
    assert {each.message for each in granted} == {text}
    assert {each.description for each in granted} == {b"described"}
    descriptor, topic = keeping.kept.ring.descriptor, keeping.flow.topic
    opener = CapsuleOpener(descriptor, {topic.name: {}})
    data = records_at(holder.store, keeping.kept.name)
    assert not any(opener.open(Record.from_wire(wire)) for wire in split(data))
    assert sum(opener.closed.values()) > 0


def test_what_was_published_a_moment_ago_is_not_uploaded(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    keeping.run(8, holder)
    assert keeping.kept.is_uploaded
    keeping.flow.publish(b"now")
    assert not keeping.kept.is_uploaded
    assert keeping.run(5, holder, until=lambda: keeping.kept.is_uploaded)
    kept = opened(records_at(holder.store, keeping.kept.name), keeping)
    assert [each.message for each in kept] == [b"now"]


def test_a_restarted_holder_goes_on_where_it_confirmed(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    sent = keeping.publish_at([0.05 * each for each in range(160)], lambda each: bytes(3_000) + b"%d" % each)
    for _ in range(4):
        keeping.run(2.1, holder)
        holder.store.close()
        holder.open()
    assert keeping.run(30, holder, until=keeping.is_uploaded)
    assert [each.message for each in opened(records_at(holder.store, keeping.kept.name), keeping)] == sent
    assert keeping.kept.poll_faults() == []


def test_a_restarted_robot_continues_its_capsule(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    first = keeping.publish_at([0.2 * each for each in range(20)], lambda each: b"before %d" % each)
    keeping.run(4.5, holder)
    keeping.keeper.close(keeping.flow.world.network.now.unix_s)
    world = keeping.flow.world
    world.restart_member(ROBOT)
    assert world.run_until_attached()
    again = Keeping(advertise(world), tmp_path / "robot")
    assert again.kept.name == keeping.kept.name
    then = again.publish_at([0.2 * each for each in range(40)], lambda each: b"after %d" % each)
    again.run(8.5, holder)
    assert again.run(40, holder, until=again.is_uploaded)
    kept = opened(records_at(holder.store, again.kept.name), again)
    assert [each.message for each in kept] == first + then
    assert len({each.incarnation for each in kept}) == 2


def test_what_the_ring_dropped_is_named_by_number(tmp_path: Path) -> None:
    world = row()
    keeping = Keeping(advertise(world), tmp_path / "robot", most_bytes=200_000)
    holder = Holder(world, tmp_path / "holder")
    keeping.publish_at([0.05 * each for each in range(240)], lambda each: bytes(3_000))
    keeping.run(2, holder)
    world.network.set_link(world.leads[ROBOT], up=False)
    keeping.run(9, holder)
    world.network.set_link(world.leads[ROBOT], up=True)
    keeping.run(2, holder)
    assert keeping.run(40, holder, until=keeping.is_uploaded)
    (capsule,) = stored(tmp_path / "holder")
    missing = {each.first for each in capsule.audit(is_deep=True).findings if each.damage is Damage.REMOVED}
    assert missing
    assert {each.damage for each in capsule.audit().findings} <= {Damage.REMOVED, Damage.UNPROVEN}
    held = {Record.from_wire(wire).number for wire in split(records_at(holder.store, keeping.kept.name))}
    assert held | missing == set(range(max(held) + 1))
    assert not held & missing
    assert any("never had" in each for each in keeping.kept.poll_faults())
    kept = opened(records_at(holder.store, keeping.kept.name), keeping)
    assert {1, 240} <= {each.sequence for each in kept}
    assert {each.description for each in kept} == {b"described"}


def test_a_span_of_time_has_its_description(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    began_ns = int(keeping.flow.world.network.now.unix_s * 1e9)
    keeping.publish_at([0.05 * each for each in range(160)], lambda each: bytes(2_000) + b"%d" % each)
    keeping.run(9, holder)
    assert keeping.run(20, holder, until=keeping.is_uploaded)
    kept, reader = read_from(holder, keeping, from_ns=began_ns + 6_000_000_000)
    assert (reader.audit.findings, reader.lost) == ([], [])
    assert 30 <= len(kept) <= 50
    assert {each.description for each in kept} == {b"described"}


def test_a_large_message_takes_several_batches(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    sent = keeping.publish_at([1.0, 2.0], lambda each: bytes([each]) * 1_500_000)
    keeping.run(8.5, holder)
    assert keeping.run(60, holder, until=keeping.is_uploaded)
    assert [each.message for each in opened(records_at(holder.store, keeping.kept.name), keeping)] == sent


def rolls_back(request: HolderRequest, answer: HolderAnswer) -> HolderAnswer:
    del request
    return HolderAnswer(head=answer.head // 2, offset=answer.offset // 2)


def runs_ahead(request: HolderRequest, answer: HolderAnswer) -> HolderAnswer:
    del request
    return HolderAnswer(head=answer.head + 10**9, offset=answer.offset + 10**9)


@pytest.mark.parametrize(
    ("lie", "words"), [(rolls_back, "rolled back"), (runs_ahead, "more than")], ids=["rolls back", "runs ahead"]
)
def test_a_holder_that_lies_about_its_head_is_named(
    tmp_path: Path, lie: Callable[[HolderRequest, HolderAnswer], HolderAnswer], words: str
) -> None:
    keeping, holder = holding(tmp_path)
    sent = keeping.publish_at([0.1 * each for each in range(80)], lambda each: bytes(500) + b"%d" % each)
    keeping.run(4, holder)
    holder.lie = lie
    keeping.run(5, holder)
    assert any(words in each for each in keeping.kept.poll_faults())
    holder.lie = None
    assert keeping.run(60, holder, until=keeping.is_uploaded)
    assert [each.message for each in opened(records_at(holder.store, keeping.kept.name), keeping)] == sent


def test_a_holder_that_withholds_rolls_back_or_forks_is_named_by_a_checkpoint_of_the_writer(tmp_path: Path) -> None:
    keeping, holder = holding(tmp_path)
    keeping.publish_at([0.1 * each for each in range(90)], lambda each: b"%d" % each)
    keeping.run(9.5, holder)
    assert keeping.run(20, holder, until=keeping.is_uploaded)
    wires = list(split(records_at(holder.store, keeping.kept.name)))
    known = [wire for wire in wires if Record.from_wire(wire).type is RecordType.CHECKPOINT][-2]
    descriptor = keeping.kept.ring.descriptor

    def damages(given: list[bytes]) -> set[Damage]:
        audit = Audit(descriptor.name, descriptor.key, known=known, is_deep=True)
        audit.add(b"".join(given))
        return {each.damage for each in audit.finish()}

    assert damages(wires) == set()
    part = len(wires) // 3
    assert damages([*wires[:part], *wires[part + 3 :]]) >= {Damage.REMOVED}
    assert damages(wires[:part]) == {Damage.ROLLED_BACK}
    other = ChainWriter(Chain(descriptor.name, descriptor.key), world_key(keeping))
    forked = [other.checkpoint(0)]
    while len(forked) < len(wires):
        forked += [other.append(RecordType.MESSAGE, 1, [b"a frame"], 1, 1), other.checkpoint(2)]
    assert Damage.FORKED in damages(forked)


def world_key(keeping: Keeping) -> SigningKey:
    """Return the writer's key, which has leaked."""
    identities = keeping.flow.world.identities.values()
    return next(each.key for each in identities if each.name == keeping.flow.member.name)
