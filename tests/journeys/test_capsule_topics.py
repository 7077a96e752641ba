"""Capsules of several topics: one log of a robot, of which each reader opens what it may."""

from __future__ import annotations

import random
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest

from gdp.capsule.audit import Damage
from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.descriptor import TOPICS_MAX, Descriptor, TopicRight
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.opening import Kept
from gdp.capsule.reading import CapsuleReader, given
from gdp.capsule.record import Record, RecordType, split
from gdp.errors import StatementError
from gdp.names import Name
from gdp.stores.capsule_store import stored
from gdp.trust.right import Right
from tests.journeys.capsules import Holder, Keeping, records_at
from tests.journeys.flows import ROBOT, Flow, advertise, row

NAMES = ("/camera", "/cmd_vel", "/scan")
READER = Name(b"r" * 32)


class Drive(NamedTuple):
    keeping: Keeping
    holder: Holder
    flows: list[Flow]


@pytest.fixture
def drive(tmp_path: Path) -> Drive:
    world = row()
    flows = [advertise(world, name) for name in NAMES]
    keeping = Keeping(flows[0], tmp_path / "robot", capsule="drive")
    for each in flows[1:]:
        keeping.keep(each)
    return Drive(keeping, Holder(world, tmp_path / "holder"), flows)


def publish(drive: Drive, flows: list[Flow], count: int, seed: int) -> dict[str, list[bytes]]:
    """Publish at drawn times of the next seconds, with drawn sizes; return what each topic got."""
    rng, sent = random.Random(seed), dict[str, list[bytes]]()
    for at, number in sorted((rng.uniform(0, 8), number) for number in range(count)):
        flow = flows[number % len(flows)]
        message = number.to_bytes(4, "big") + rng.randbytes(rng.choice([8, 900, 6_000]))
        sent.setdefault(flow.name, []).append(message)
        flow.world.network.call(at, partial(flow.publish, message))
    drive.keeping.run(8.3, drive.holder)
    assert drive.keeping.run(30, drive.holder, until=lambda: drive.keeping.keeper.is_uploaded)
    return sent


def read(holder: Holder, flows: list[Flow], from_ns: int = 0) -> tuple[dict[str, list[bytes]], list[CapsuleReader]]:
    """Return what a reader with the secrets of these topics gets, by their names."""
    names, readers, found = (
        {each.topic.name: each.name for each in flows},
        list[CapsuleReader](),
        dict[str, list[bytes]](),
    )
    capsules = {each.name: each for name in names for each in given(ask(holder, ask=Ask.LIST, topic=name).descriptors)}
    for each in sorted(capsules.values(), key=lambda each: each.begun_ms):
        secrets = {flow.topic.name: flow.topic.secrets for flow in flows if flow.topic.name in each.topics}
        readers.append(CapsuleReader(each, secrets, from_ns=from_ns))
        while not readers[-1].is_done:
            answer = holder.store.handle(readers[-1].next_request().to_cbor(), READER)
            for kept in readers[-1].handle_response(HolderAnswer.from_cbor(answer)):
                found.setdefault(names[kept.topic], []).append(kept.message)
    return found, readers


def ask(holder: Holder, **fields: object) -> HolderAnswer:
    return HolderAnswer.from_cbor(holder.store.handle(HolderRequest(**fields).to_cbor(), READER))  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [1, 2])
def test_topics_of_one_label_share_a_capsule_and_each_is_whole(drive: Drive, seed: int) -> None:
    sent = publish(drive, drive.flows, 120, seed)
    (capsule,) = stored(drive.holder.folder)
    assert set(capsule.descriptor.topics) == {each.topic.name for each in drive.flows}
    assert capsule.audit(is_deep=True).findings == []
    found, (reader,) = read(drive.holder, drive.flows)
    assert found == sent
    assert (reader.lost, reader.audit.findings, reader.opener.closed) == ([], [], {})
    assert [path.name for path in drive.keeping.folder.iterdir()] == ["drive"]
    assert len(list((drive.keeping.folder / "drive").iterdir())) == 1


def test_a_reader_of_one_topic_opens_that_alone_and_finds_the_capsule_by_it(drive: Drive) -> None:
    sent = publish(drive, drive.flows, 60, 3)
    for flow in drive.flows:
        found, (reader,) = read(drive.holder, [flow])
        assert found == {flow.name: sent[flow.name]}
        assert (reader.lost, reader.audit.findings) == ([], [])


def test_a_reader_from_the_middle_on_has_the_descriptions_of_all_topics(drive: Drive) -> None:
    sent = publish(drive, drive.flows, 90, 4)
    records = [Record.from_wire(each) for each in split(records_at(drive.holder.store, drive.keeping.kept.name))]
    middle = records[len(records) // 2].time_ns
    found, (reader,) = read(drive.holder, drive.flows, middle)
    assert all(sent[name][-len(of) :] == of for name, of in found.items())
    assert set(found) == set(NAMES)
    assert set(reader.opener.descriptions.values()) == {b"described"}


def test_another_topic_begins_another_capsule_and_nothing_is_lost_between(drive: Drive) -> None:
    sent = publish(drive, drive.flows, 30, 5)
    late = advertise(drive.flows[0].world, "/late")
    for number in range(5):
        late.world.network.call(0.1 * number, partial(drive.flows[0].publish, b"%d" % number))
    drive.keeping.run(0.31, drive.holder)  # some are in the ring, some are not yet published
    drive.keeping.keep(late)
    assert len(drive.keeping.keeper.ended) == 1
    more = publish(drive, [*drive.flows, late], 40, 6)
    found, readers = read(drive.holder, [*drive.flows, late])
    first = sent["/camera"] + [b"%d" % number for number in range(5)] + more["/camera"]
    assert sorted(found["/camera"]) == sorted(first)
    assert {name: found[name] for name in NAMES[1:]} == {name: sent[name] + more[name] for name in NAMES[1:]}
    assert found["/late"] == more["/late"]
    assert [len(each.descriptor.topics) for each in readers] == [3, 4]
    assert not any(each.audit.findings or each.lost for each in readers)
    assert len(list((drive.keeping.folder / "drive").iterdir())) == 1, "what was superseded and uploaded is gone"


def test_a_capsule_that_was_superseded_is_uploaded_by_the_next_process(tmp_path: Path, drive: Drive) -> None:
    world = drive.flows[0].world
    drive.keeping.keeper.topics[drive.flows[0].topic.name].flush(int(world.network.now.unix_s * 1e9))
    for number in range(4):
        drive.flows[1].publish(b"%d" % number)
    late = advertise(world, "/late")
    drive.keeping.keep(late)
    drive.keeping.keeper.close(world.network.now.unix_s)  # before anything is uploaded
    assert len(list((tmp_path / "robot/drive").iterdir())) == 2
    world.restart_member(ROBOT)
    assert world.run_until_attached()
    flow = advertise(world, NAMES[0])
    again = Keeping(flow, tmp_path / "robot", capsule="drive")
    assert set(again.kept.ring.descriptor.topics) == {each.topic.name for each in (*drive.flows, late)}
    assert again.run(30, drive.holder, until=lambda: again.keeper.is_uploaded)
    again.run(8, drive.holder)
    found, readers = read(drive.holder, drive.flows)
    assert found == {NAMES[1]: [b"0", b"1", b"2", b"3"]}
    assert [len(each.descriptor.topics) for each in readers] == [3, 4]


def test_what_waits_for_a_slow_disk_is_kept_in_the_capsule_that_another_topic_ends(drive: Drive) -> None:
    sent, before = publish(drive, drive.flows, 30, 7), drive.keeping.kept
    before.ring._given_bytes += 1 << 30  # the disk is too slow
    for number in range(3):
        drive.flows[0].publish(b"%d" % number)
    late = advertise(drive.flows[0].world, "/late")
    drive.keeping.keep(late)
    before.ring._given_bytes -= 1 << 30
    assert drive.keeping.run(30, drive.holder, until=lambda: drive.keeping.keeper.is_uploaded)
    found, readers = read(drive.holder, drive.flows)
    assert found["/camera"] == [*sent["/camera"], b"0", b"1", b"2"]
    assert not any(each.audit.findings or each.lost for each in readers)


def test_a_mark_is_one_record_that_a_reader_of_any_topic_opens(drive: Drive) -> None:
    publish(drive, drive.flows, 12, 7)
    drive.keeping.kept.mark("bumped", int(drive.flows[0].world.network.now.unix_s * 1e9))
    publish(drive, drive.flows, 12, 8)
    data = records_at(drive.holder.store, drive.keeping.kept.name)
    assert [each.type for each in map(Record.from_wire, split(data))].count(RecordType.MARK) == 1
    for flows in (drive.flows, *([each] for each in drive.flows)):
        _, (reader,) = read(drive.holder, flows)
        assert [each.name for each in reader.opener.marks] == ["bumped"]
        assert reader.audit.findings == []
    _, (reader,) = read(drive.holder, drive.flows[:1])
    (capsule,) = stored(drive.holder.folder)
    assert capsule.audit(is_deep=True).findings == []


def test_a_window_has_all_topics_each_with_its_description(tmp_path: Path) -> None:
    world = row()
    flows = [advertise(world, name) for name in NAMES]
    keeping = Keeping(flows[0], tmp_path / "robot", around_ns=(2 * 10**9, 10**9), capsule="drive")
    for each in flows[1:]:
        keeping.keep(each)
    site = Drive(keeping, Holder(world, tmp_path / "holder"), flows)
    for at in range(120):
        world.network.call(0.1 * at, partial(flows[at % 3].publish, at.to_bytes(4, "big")))
    world.network.call(8, lambda: keeping.kept.mark("/estop", int(world.network.now.unix_s * 1e9)))
    keeping.run(13, site.holder)
    found, (reader,) = read(site.holder, flows)
    assert set(found) == set(NAMES)
    numbers = sorted(int.from_bytes(each, "big") for of in found.values() for each in of)
    assert set(range(62, 88)) <= set(numbers)
    assert numbers[0] > 40
    assert set(reader.opener.descriptions) == {each.topic.name for each in flows}
    assert (reader.lost, reader.audit.findings) == ([], [])


def test_messages_that_never_reached_the_holder_are_named_by_topic(drive: Drive) -> None:
    publish(drive, drive.flows, 60, 9)
    data = records_at(drive.holder.store, drive.keeping.kept.name)
    wires = list(split(data))
    scan = drive.flows[2].topic.name
    of_scan = [at for at, each in enumerate(wires) if topic_of(each) == scan]
    missing = of_scan[len(of_scan) // 2]
    gone = Record.from_wire(wires[missing])
    secrets = {each.topic.name: each.topic.secrets for each in drive.flows}
    reader = CapsuleReader(drive.keeping.kept.ring.descriptor, secrets)
    pieces = b"".join([*wires[:missing], *wires[missing + 1 :]])
    kept = list[Kept](reader.handle_response(HolderAnswer(data=pieces)))
    list(reader.handle_response(HolderAnswer(offset=len(pieces))))
    assert {each.topic for each in reader.lost} == {scan}
    (lost,) = reader.lost
    assert (lost.first, lost.last) == (gone.sequence, gone.sequence + gone.messages - 1)
    assert [each.damage for each in reader.audit.findings] == [Damage.REMOVED]
    assert len(kept) == 60 - gone.messages


def topic_of(wire: bytes) -> bytes:
    record = Record.from_wire(wire)
    return record.frames[0][32:64] if record.type is RecordType.MESSAGE else b""


@pytest.mark.momentary("about records, no lease matters")
def test_a_writer_needs_a_right_for_each_topic(drive: Drive) -> None:
    descriptor = drive.keeping.kept.ring.descriptor
    descriptor.check_right(drive.flows[0].world.network.now.unix_s)
    world = drive.flows[0].world
    reader = world.topic("/cmd_vel", drive.flows[0].member, [Right.READ]).delegation
    without = descriptor.rights[0], TopicRight(reader.subject, reader.chain), descriptor.rights[2]
    forged = Descriptor.of_topics(without, descriptor.certificate, descriptor.begun_ms)
    assert forged.name == descriptor.name
    with pytest.raises(StatementError):
        forged.check_right(world.network.now.unix_s)
    assert given([forged]) == []


@pytest.mark.momentary("about records, no lease matters")
def test_a_record_of_a_topic_that_is_not_the_capsules_is_refused_by_readers(drive: Drive) -> None:
    world, keeping = drive.flows[0].world, drive.keeping
    other = advertise(world, "/other")
    sealed = list[list[bytes]]()
    other.publisher.record(lambda frames, _sequence, _count: sealed.append(frames[:]), lambda *_: None)
    other.publish(b"claimed")
    other.publisher.seal_recorded()
    key = next(each for each in world.identities.values() if each.name == other.member.name).key
    writer = ChainWriter(Chain(keeping.kept.name, key.public), key)
    data = writer.checkpoint(1) + writer.append(RecordType.MESSAGE, 2, sealed[0], 1, 1) + writer.checkpoint(3)
    secrets = {each.topic.name: each.topic.secrets for each in (*drive.flows, other)}
    reader = CapsuleReader(keeping.kept.ring.descriptor, secrets)
    assert list(reader.handle_response(HolderAnswer(data=data))) == []
    list(reader.handle_response(HolderAnswer(offset=len(data))))
    assert [each.damage for each in reader.audit.findings] == [Damage.ALTERED]


@pytest.mark.momentary("about records, no lease matters")
def test_the_name_depends_on_each_topic_and_their_number_is_bounded(drive: Drive) -> None:
    descriptor = drive.keeping.kept.ring.descriptor
    rights = descriptor.rights
    names = {
        Descriptor.of_topics(each, descriptor.certificate, descriptor.begun_ms).name
        for each in (rights, rights[:2], rights[:1], rights[::-1])
    }
    assert len(names) == 4
    assert Descriptor.from_cbor(descriptor.to_cbor()) == descriptor
    too_many = Descriptor.of_topics([rights[0]] * (TOPICS_MAX + 1), descriptor.certificate, 1)
    with pytest.raises(StatementError):
        Descriptor.from_cbor(too_many.to_cbor())
