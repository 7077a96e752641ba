"""Properties of every store: in memory and replicated, read back from a snapshot, shared in a cluster."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sqlite3
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from gdp.control.rib_replication import Entry, Key
from gdp.crypto.validity import Validity
from gdp.errors import DropReason
from gdp.limits import CLOCK_SKEW_S
from gdp.names import Name
from gdp.nodes.rib_upkeep import MemoryUpkeep
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.stores.snapshot import SLICE, Snapshot
from gdp.trust.rtcert import RtCert
from tests.gdp.stores.sites import (
    EVIDENCE_S,
    MemoryPair,
    Pair,
    Site,
    SnapshotPair,
    acks,
    answers,
)

FORGOTTEN_S = EVIDENCE_S + int(CLOCK_SKEW_S) + 1  # after this no node accepts the advertisement any more


@pytest.fixture(params=["memory", "snapshot"])
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Pair]:
    made = MemoryPair(Site()) if request.param == "memory" else SnapshotPair(Site(), tmp_path / "rib.sqlite")
    yield made
    made.close()


class TestEveryStore:
    def test_what_one_rib_took_the_other_answers(self, pair: Pair) -> None:
        assert acks(pair.give(pair.one, pair.site.relay("/a", 1)))[0].refused is None
        pair.sync()
        (answer,) = answers(pair.give(pair.two, pair.site.query("/a")))
        assert (answer.advertiser, answer.domain) == (pair.site.robot.name, pair.site.authority.root.domain)

    def test_a_watch_at_one_rib_hears_what_the_other_took(self, pair: Pair) -> None:
        if isinstance(pair, MemoryPair):
            pair.sync()  # a RIB that has not met its peer sends no negative response
        pair.give(pair.two, pair.site.query("/a", watch_s=20.0))
        pair.give(pair.one, pair.site.relay("/a", 1))
        assert [each.advertisement != b"" for each in answers(pair.sync())] == [True]

    def test_an_older_advertisement_is_stale_whichever_rib_it_comes_to(self, pair: Pair) -> None:
        pair.give(pair.one, pair.site.relay("/a", 5))
        pair.sync()
        (ack,) = acks(pair.give(pair.two, pair.site.relay("/a", 4)))
        assert (ack.refused, ack.sequence) == (DropReason.STALE, 5)

    def test_a_withdrawal_holds_at_both(self, pair: Pair) -> None:
        pair.give(pair.one, pair.site.relay("/a", 1))
        pair.sync()
        pair.give(pair.one, pair.site.withdrawal("/a", 2))
        pair.sync()
        assert [each.is_negative for each in answers(pair.give(pair.two, pair.site.query("/a")))] == [True]
        assert [each.refused for each in acks(pair.give(pair.two, pair.site.relay("/a", 1)))] != [None]

    def test_a_lease_ends_at_both(self, pair: Pair) -> None:
        pair.give(pair.one, pair.site.relay("/a", 1, lease_s=2.0))
        pair.sync()
        assert len(answers(pair.give(pair.two, pair.site.query("/a"), 1.0))) == 1
        pair.wait_until(3.1)
        for rib in (pair.one, pair.two):
            rib.handle_timer(pair.site.now(3.1))
            pair.take(rib)
        assert [each.is_negative for each in answers(pair.give(pair.two, pair.site.query("/a"), 3.1))] == [True]


def test_peers_forget_a_withdrawal_when_the_advertisement_can_be_proven_no_more() -> None:
    pair = MemoryPair(Site())
    pair.sync()
    pair.give(pair.one, pair.site.relay("/a", 1))
    pair.give(pair.one, pair.site.withdrawal("/a", 2))
    pair.sync()
    held = [rib.state.store.count_of(pair.site.switch.name) for rib in (pair.one, pair.two)]
    for later_s in range(FORGOTTEN_S, FORGOTTEN_S + 4):
        pair.sync(later_s)  # neither learns it again from the other
    left = [rib.state.store.count_of(pair.site.switch.name) for rib in (pair.one, pair.two)]
    assert (held, left) == ([1, 1], [0, 0])


def test_a_peer_forgets_no_withdrawal_sooner_than_what_it_knows_of_the_advertisement_says() -> None:
    pair = MemoryPair(Site())
    pair.sync()
    pair.give(pair.one, pair.site.relay("/a", 1))
    pair.sync()
    key = (pair.site.subject("/a").name, pair.site.robot.name)
    pair.give(pair.one, pair.site.withdrawal("/a", 2))
    entry = pair.one.state.entry_of(key, pair.site.now().mono_s)
    assert entry is not None
    pair.two.load([replace(entry, until_unix_s=int(pair.site.unix_s) + 10)], pair.site.now())
    pair.two.handle_timer(pair.site.now(11.0))
    assert [each.refused for each in acks(pair.give(pair.two, pair.site.relay("/a", 1), 11.0))] == [DropReason.STALE]


def test_a_snapshot_keeps_no_withdrawal_for_longer_than_the_rib(tmp_path: Path) -> None:
    path = tmp_path / "rib.sqlite"
    pair = SnapshotPair(Site(), path)
    for number in range(3):
        pair.give(pair.one, pair.site.relay(f"/{number}", 1))
        pair.give(pair.one, pair.site.withdrawal(f"/{number}", 2))
    pair.sync()
    rows = []
    for later_s in (0.0, float(FORGOTTEN_S)):
        pair.one.handle_timer(pair.site.now(later_s))
        pair.sync(later_s)
        with contextlib.closing(sqlite3.connect(path)) as database:
            rows.append(database.execute("SELECT count(*) FROM entries").fetchone()[0])
    assert rows == [3, 0]


def test_a_broken_snapshot_is_put_aside_and_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "rib.sqlite"
    path.write_bytes(b"this is no database" * 100)
    snapshot = Snapshot(path)
    assert list(snapshot.load(0.0)) == []
    assert (snapshot.failures, path.exists(), (tmp_path / "rib.sqlite.broken").exists()) == (1, False, True)
    assert "cannot be read" in caplog.text


def test_a_snapshot_that_cannot_be_written_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    snapshot = Snapshot(tmp_path / "missing" / "rib.sqlite")
    snapshot.start()
    for _ in range(3):
        snapshot.write([], 0.0)
    snapshot.close()
    assert snapshot.failures >= 3
    assert caplog.text.count("snapshot not written") == 1


def changes_of(pair: Pair, names: Sequence[str], rib: RibCore) -> list[tuple[Key, Entry | None]]:
    keys = [(pair.site.subject(name).name, pair.site.robot.name) for name in names]
    return [(key, rib.state.entry_of(key, pair.site.now().mono_s)) for key in keys]


def test_what_could_not_be_written_is_written_when_the_disk_has_space_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr("gdp.stores.background_database.TICK_S", 0.001)
    pair, folder = MemoryPair(Site()), tmp_path / "disk"
    pair.give(pair.one, pair.site.relay("/a", 1))
    snapshot = Snapshot(folder / "rib.sqlite")
    snapshot.start()
    snapshot.write(changes_of(pair, ["/a"], pair.one), pair.site.unix_s)
    while snapshot.failures < 3:
        time.sleep(0.001)
    folder.mkdir()
    while "snapshot written again" not in caplog.text:
        time.sleep(0.001)
    snapshot.close()
    read = [entry for entries in Snapshot(folder / "rib.sqlite").load(pair.site.unix_s) for entry in entries]
    assert len(read) == 1
    assert caplog.text.count("snapshot not written") == 1


def test_what_waits_for_a_full_disk_is_bounded_by_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gdp.stores.background_database.TICK_S", 0.001)
    monkeypatch.setattr("gdp.nodes.rib_upkeep.CHANGES_MAX", 4)
    site, folder = Site(), tmp_path / "disk"
    upkeep = MemoryUpkeep(folder / "rib.sqlite")
    rib = RibCore(site.ribs[0], site.policy(), upkeep.store, RibSettings())
    upkeep.start(rib, site.now())
    waiting = upkeep._memory.changes
    assert waiting is not None
    for number in range(100):
        begin = site.now(100.0 * number)
        site.rtcert = RtCert.make(site.robot, site.switch.name, Validity.lasting(begin.unix_s, 50))
        rib.receive(site.relay(f"/{number}", 1, lease_s=5.0), site.switch.name, begin)
        for later_s in (10.0, 60.0):  # the lease ends, then the memory of it
            rib.handle_timer(site.now(100.0 * number + later_s))
        upkeep.work(site.now(100.0 * number + 60.0))
        waiting = upkeep._memory.changes
        assert waiting is not None
        assert len(waiting) <= 2 * len(set(upkeep._memory.known())) + 5
    folder.mkdir()
    end = site.now(10_000.0)
    site.rtcert = RtCert.make(site.robot, site.switch.name, Validity.lasting(end.unix_s, 50))
    rib.receive(site.relay("/last", 1), site.switch.name, end)
    while waiting := upkeep._memory.changes:
        upkeep.work(end)
    upkeep.close()
    (read,) = Snapshot(folder / "rib.sqlite").load(end.unix_s)
    assert len(read) == 1


def test_a_file_that_could_not_be_read_at_the_start_is_replaced_and_not_added_to(tmp_path: Path) -> None:
    pair, path = MemoryPair(Site()), tmp_path / "rib.sqlite"
    for name in ("/a", "/b"):
        pair.give(pair.one, pair.site.relay(name, 1))
    for name, is_locked in (("/a", False), ("/b", True)):
        with contextlib.closing(sqlite3.connect(path)) as other:
            if is_locked:
                other.execute("PRAGMA locking_mode=EXCLUSIVE")
                other.execute("BEGIN EXCLUSIVE")
            snapshot = Snapshot(path)
            assert list(snapshot.load(pair.site.unix_s)) == []
        snapshot.start()
        snapshot.write(changes_of(pair, [name], pair.one), pair.site.unix_s)
        snapshot.close()
    (read,) = Snapshot(path).load(pair.site.unix_s)
    ((_, wanted),) = changes_of(pair, ["/b"], pair.one)
    assert wanted is not None
    assert [entry.statement for entry in read] == [wanted.statement]


def write_generations(path: Path, said: Connection) -> None:
    snapshot = Snapshot(path)
    list(snapshot.load(0.0))
    snapshot.start()
    for generation in count(1):
        said.send(generation)
        while not snapshot.is_ready:
            time.sleep(0.001)
        snapshot.write(slice_of(generation), 0.0)


def slice_of(generation: int) -> list[tuple[Key, Entry | None]]:
    name = Name(b"n" * 32)
    entry = Entry(
        statement=generation.to_bytes(8, "big") * 64,
        membership=b"",
        sender=name,
        domain=name,
        via=name,
        transit=(),
        lease_s=60.0,
        is_from_upstream=False,
    )
    return [((Name(at.to_bytes(32, "big")), name), entry) for at in range(1, SLICE + 1)]


@pytest.mark.parametrize("generations", [10, 25, 50])
def test_of_a_killed_writer_a_slice_is_read_whole_or_not_at_all(tmp_path: Path, generations: int) -> None:
    path = tmp_path / "rib.sqlite"
    heard, said = multiprocessing.Pipe()
    writer = multiprocessing.get_context("spawn").Process(target=write_generations, args=(path, said))
    writer.start()
    while heard.recv() < generations:
        pass
    assert writer.pid is not None
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    (read,) = Snapshot(path).load(0.0)
    assert len(read) == SLICE
    assert len({entry.statement for entry in read}) == 1


def test_an_altered_entry_of_a_snapshot_is_not_believed(tmp_path: Path) -> None:
    pair = SnapshotPair(Site(), tmp_path / "rib.sqlite")
    pair.give(pair.one, pair.site.relay("/a", 1))
    pair.sync()
    other = Site()
    rib = RibCore(other.ribs[0], other.policy(), MemoryStore(), pair.one.state.settings)
    for entries in Snapshot(tmp_path / "rib.sqlite").load(other.unix_s):
        rib.load(entries, other.now())
    assert (rib.names, rib.state.refusals) == (0, {DropReason.WRONG_DOMAIN: 1})
