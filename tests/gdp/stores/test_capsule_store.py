"""Holder's store: it keeps what is the writer's, confirms what is on the disk, and says why it refuses."""

from __future__ import annotations

import os
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest

from gdp.capsule.audit import Damage
from gdp.capsule.chain import ChainWriter
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.record import Record, RecordType
from gdp.crypto.cbor import encode
from gdp.errors import GdpError, LocalError, StoreError
from gdp.names import Name
from gdp.stores import capsule_ring, capsule_store
from gdp.stores.capsule_store import CapsuleStore, StoreLimits, remove, stored
from gdp.stores.segments import Segments
from gdp.trust.right import Right
from tests.gdp.capsule.log import SECOND_NS, Log
from tests.gdp.capsule.owned import NOW_S, descriptor, writer

LIMITS = StoreLimits(owner_bytes=1 << 23, spare_bytes=0)


def log_of(about: Descriptor | None = None, count: int = 30, size: int = 20) -> Log:
    return Log(writer().key, (about or descriptor()).name).add(count, size).closed()


class Holder:
    """A store, and the calls of a writer."""

    def __init__(self, folder: Path, limits: StoreLimits = LIMITS, unix_s: float = NOW_S) -> None:
        self.folder, self.limits, self.unix_s = folder, limits, unix_s
        self.store = CapsuleStore(folder, limits, lambda: self.unix_s)

    def restart(self) -> None:
        self.store.close()
        self.store = CapsuleStore(self.folder, self.limits, lambda: self.unix_s)

    def append(
        self, data: bytes, offset: int, about: Descriptor | None = None, client: Name | None = None, gap: int = 0
    ) -> HolderAnswer:
        about = about or descriptor()
        request = HolderRequest(ask=Ask.APPEND, capsule=about.name, offset=offset, data=data, gap=gap, descriptor=about)
        return HolderAnswer.from_cbor(self.store.handle(request.to_cbor(), client or writer().name))

    def ask(self, ask: Ask, about: Descriptor | None = None, **more: int) -> HolderAnswer:
        request = HolderRequest(ask=ask, capsule=(about or descriptor()).name, **more)  # type: ignore[arg-type]
        return HolderAnswer.from_cbor(self.store.handle(request.to_cbor(), Name(b"r" * 32)))


@pytest.fixture
def holder(tmp_path: Path) -> Holder:
    return Holder(tmp_path / "store")


def test_bytes_come_back_as_they_were_appended_in_any_pieces(holder: Holder) -> None:
    data = b"".join(log_of().wires)
    at = 0
    for size in (1, 7, 500, 3, 2_000, len(data)):
        answer = holder.append(data[at : at + size], at)
        at = min(at + size, len(data))
        assert answer.offset == at
        assert answer.head <= at
    assert answer.head == len(data)
    assert holder.ask(Ask.READ).data == data
    holder.restart()
    assert holder.ask(Ask.HEAD).head == len(data)
    assert holder.ask(Ask.READ, offset=100).data == data[100:]


def test_a_repeated_append_changes_nothing_and_other_bytes_are_a_fork(holder: Holder) -> None:
    data = b"".join(log_of().wires)
    holder.append(data, 0)
    assert holder.append(data[50:300], 50).head == len(data)
    with pytest.raises(LocalError, match="fork"):
        holder.append(b"x" * 20, 50)


def test_what_is_not_confirmed_is_appended_again_after_a_restart(holder: Holder) -> None:
    log = log_of()
    data = b"".join(log.wires)
    answer = holder.append(data[:1_000], 0)
    assert answer.head < answer.offset == 1_000
    holder.restart()
    assert (holder.ask(Ask.HEAD).head, holder.ask(Ask.HEAD).offset) == (answer.head, answer.head)
    assert holder.append(data[answer.head :], answer.head).head == len(data)


@pytest.mark.parametrize("at", [0, 5, -1])
def test_records_that_are_not_the_writers_are_not_kept(holder: Holder, at: int) -> None:
    wires = log_of().wires
    record = Record.from_wire(wires[at])
    wires[at] = record._replace(body=record.body[:-1] + bytes([record.body[-1] ^ 1])).to_wire()
    with pytest.raises(GdpError):
        holder.append(b"".join(wires), 0)
    assert holder.ask(Ask.HEAD).head == 0


def test_only_the_writer_appends_and_only_with_the_owners_leave(holder: Holder) -> None:
    data, wrong = b"".join(log_of().wires), descriptor("/other", Right.READ)
    with pytest.raises(LocalError, match="another node"):
        holder.append(data, 0, client=Name(b"e" * 32))
    with pytest.raises(GdpError, match="publish"):
        holder.append(b"".join(log_of(wrong).wires), 0, wrong)
    with pytest.raises(GdpError):
        holder.append(data, 0, replace(descriptor(), chain=()))
    holder.unix_s = NOW_S + 10_000_000
    late = descriptor("/late")
    with pytest.raises(GdpError, match="expired"):
        holder.append(b"".join(log_of(late).wires), 0, late)


def test_a_gap_ends_with_a_checkpoint_and_is_named(holder: Holder) -> None:
    log = log_of()
    types = [Record.from_wire(wire).type for wire in log.wires]
    second = types.index(RecordType.CHECKPOINT, 1)
    third = types.index(RecordType.CHECKPOINT, second + 1)
    offsets = [sum(map(len, log.wires[:at])) for at in range(len(log.wires))]
    holder.append(b"".join(log.wires[: second + 1]), 0)
    with pytest.raises(GdpError):
        holder.append(log.wires[third - 1], offsets[third - 1])
    data, gap = b"".join(log.wires[third:]), offsets[third] - offsets[second + 1]
    with pytest.raises(StoreError, match=f"{gap} bytes before"):  # the writer may have them
        holder.append(data, offsets[third])
    assert holder.append(data, offsets[third], gap=gap).head == offsets[third] + len(data)
    answer = holder.ask(Ask.READ, offset=offsets[second + 1])
    assert (answer.offset, answer.data) == (offsets[third], data)
    (capsule,) = stored(holder.folder)
    missing = [each.first for each in capsule.audit().findings if each.damage is Damage.REMOVED]
    assert missing == list(range(second + 1, third))


def test_a_time_is_found_and_the_index_is_made_again_where_it_is_gone(holder: Holder) -> None:
    data = b"".join(log_of(count=80).wires)
    holder.append(data, 0)
    for _ in range(2):
        answer = holder.ask(Ask.READ, time_ns=4 * SECOND_NS)
        first = Record.from_wire(answer.data[: 4 + int.from_bytes(answer.data[:4], "big")])
        assert first.type is RecordType.CHECKPOINT
        assert 2 * SECOND_NS < first.time_ns <= 4 * SECOND_NS
        holder.store.close()
        for file in holder.folder.glob("index.db*"):
            file.unlink()
        holder.restart()


def test_a_start_reads_the_last_segment_once_and_no_other_that_is_indexed(
    holder: Holder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capsule_store, "SEGMENT_BYTES", 4_000)
    holder.append(b"".join(log_of(count=80).wires), 0)
    (capsule,) = stored(holder.folder)
    assert len(capsule.segments.offsets) > 2
    with mock.patch.object(Segments, "read", autospec=True, side_effect=Segments.read) as read:
        holder.restart()
    assert [each.args[1] for each in read.call_args_list] == [capsule.segments.last]


def test_an_owner_has_a_quota_for_all_its_topics(tmp_path: Path) -> None:
    holder = Holder(tmp_path / "store", StoreLimits(owner_bytes=3 << 20, spare_bytes=0))
    large, at = b"".join(log_of(count=80, size=50_000).wires), 0
    for at in range(0, 3 << 20, 1 << 18):
        holder.append(large[at : at + (1 << 18)], at)
    with pytest.raises(StoreError, match=r"topics' owner has .* quota"):
        holder.append(large[at + (1 << 18) :][: 1 << 18], at + (1 << 18))


def test_a_member_that_invents_owners_has_a_quota_too(tmp_path: Path) -> None:
    holder = Holder(tmp_path / "store", StoreLimits(owner_bytes=3 << 20, spare_bytes=0))
    for which in range(3):
        about = descriptor("/mine", which=which)
        assert holder.append(b"".join(log_of(about).wires[:10]), 0, about).head > 0
    with pytest.raises(StoreError, match=r"writer has .* quota"):
        holder.append(b"".join(log_of(descriptor("/mine", which=3)).wires), 0, descriptor("/mine", which=3))
    assert len(list(stored(holder.folder))) == 3


def test_the_oldest_segments_go_by_bytes_and_by_age(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capsule_store, "SEGMENT_BYTES", 4_000)
    data = b"".join(log_of(count=80).wires)
    holder = Holder(tmp_path / "bytes", StoreLimits(owner_bytes=1 << 20, capsule_bytes=10_000, spare_bytes=0))
    holder.append(data, 0)
    (capsule,) = stored(holder.folder)
    assert 0 < capsule.segments.held_bytes <= 10_000
    assert capsule.audit().findings == []
    assert capsule.audit().begin > 0
    aged = Holder(tmp_path / "age", StoreLimits(owner_bytes=1 << 20, age_s=3.0, spare_bytes=0), unix_s=NOW_S)
    aged.append(data[:5_000], 0)
    aged.unix_s = 11.0  # the records say that they are of the first nine seconds
    aged.append(data[5_000:], 5_000)
    assert 0 < aged.ask(Ask.READ, time_ns=1).offset < len(data)


def test_a_full_disk_refuses_and_says_so(holder: Holder) -> None:
    data = b"".join(log_of().wires)
    holder.append(data[:3_000], 0)
    Free = namedtuple("Free", "f_bavail f_frsize")
    with mock.patch.object(os, "statvfs", return_value=Free(1, 512)), pytest.raises(StoreError, match="No space left"):
        holder.append(data[3_000:], 3_000)
    assert holder.append(data[3_000:], 3_000).head == len(data)


def test_a_write_that_fails_in_the_middle_leaves_nothing(holder: Holder) -> None:
    data = b"".join(log_of().wires)
    before = holder.append(data[:3_000], 0).head
    with mock.patch.object(os, "fdatasync", side_effect=OSError(5, "Input/output error")), pytest.raises(StoreError):
        holder.append(data[3_000:], 3_000)
    (capsule,) = stored(holder.folder)
    assert capsule.segments.end == before
    assert holder.append(data[3_000:], 3_000).head == len(data)


def test_a_torn_write_is_cut_and_a_damage_stops_appends(holder: Holder) -> None:
    data = b"".join(log_of().wires)
    holder.append(data, 0)
    (file,) = (holder.folder / descriptor().name.to_text()).glob("*.records")
    with file.open("ab") as opened:
        opened.write(bytes(300))
    holder.restart()
    assert holder.ask(Ask.HEAD).head == len(data)
    altered = bytearray(data)
    altered[len(data) // 2] ^= 1
    file.write_bytes(altered)
    holder.restart()
    assert holder.ask(Ask.HEAD).head == len(data)
    with pytest.raises(GdpError):
        holder.append(data[:10], len(data))
    (capsule,) = stored(holder.folder)
    assert {each.damage for each in capsule.audit().findings} == {Damage.ALTERED}


def test_capsules_are_listed_by_topic_and_removed(holder: Holder) -> None:
    other = descriptor("/more")
    holder.append(b"".join(log_of().wires), 0)
    holder.append(b"".join(log_of(other).wires), 0, other)
    asked = HolderRequest(ask=Ask.LIST, topic=other.topic.name)
    found = HolderAnswer.from_cbor(holder.store.handle(asked.to_cbor(), writer().name)).descriptors
    assert found == (other,)
    remove(holder.folder, other.name)
    assert [each.name for each in stored(holder.folder)] == [descriptor().name]
    with pytest.raises(LocalError):
        remove(holder.folder, other.name)


@pytest.mark.parametrize("wire", [b"", b"\xa0", encode({"ask": "steal"}), encode({"ask": "head", "capsule": b"x"})])
def test_arbitrary_requests_are_refused(holder: Holder, wire: bytes) -> None:
    with pytest.raises(GdpError):
        holder.store.handle(wire, writer().name)


def test_a_ring_continues_behind_its_last_record(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        for start in range(3):
            ring = capsule_ring.CapsuleRing(tmp_path, replace(descriptor(), begun_ms=NOW_S + start), 1 << 20, pool)
            assert ring.descriptor.begun_ms == NOW_S
            writes = ChainWriter(ring.chain, writer().key)
            assert writes.chain.number == 2 * start
            ring.append(writes.checkpoint(start), begins_file=ring.wants_file)
            ring.append(writes.append(RecordType.MESSAGE, start, [b"frame"], start + 1, 1), begins_file=False)
            ring.close()


def test_a_ring_drops_its_oldest_files(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        ring = capsule_ring.CapsuleRing(tmp_path, descriptor(), 80_000, pool)
        writes = ChainWriter(ring.chain, writer().key)
        for at in range(40):
            ring.append(writes.checkpoint(at), begins_file=ring.wants_file)
            ring.append(writes.append(RecordType.MESSAGE, at, [bytes(6_000)], at + 1, 1), begins_file=False)
        ring.close()
        assert 0 < ring.end - ring.begin <= 80_000
        assert ring.begin > 0
        offset, data = ring.read(0, 1_000).result()
        assert offset == ring.begin
        assert data
