"""Journal of a cluster on disk, shared by processes."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from fog.cluster import CloudNode, ClusterPlan, ExportedInterface
from fog.supervisor.core.record import Outcome
from fog.supervisor.journal import Journal
from gdp.errors import LocalError, StoreError
from tests.fog.supervisor.machines import NOW_S, SPOT, record, serving

PLAN = ClusterPlan(
    "c", (CloudNode("p", "e"),), (SPOT, SPOT), (ExportedInterface("service", "/s", "std_srvs/srv/SetBool"),)
)


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    journal = Journal(tmp_path / "journal.sqlite3")
    yield journal
    journal.close()


def test_what_is_written_another_process_reads(journal: Journal, tmp_path: Path) -> None:
    journal.put_cluster(PLAN, NOW_S)
    other = Journal(tmp_path / "journal.sqlite3")
    assert other.cluster("c").plan == PLAN
    other.close()


def test_a_machine_comes_back_as_it_was(journal: Journal) -> None:
    ended = serving("m2").ended(Outcome.PREEMPTED, "preempted", NOW_S)
    for each in (record("m1"), ended, replace(record("m10"), id="")):
        journal.put(each, NOW_S)
        assert each in journal.machines("c")
    assert [each.name for each in journal.machines("c")] == ["m1", "m2", "m10"]
    assert [each.name for each in journal.machines("c", gone=False)] == ["m1", "m10"]


def test_no_name_of_a_machine_comes_twice(journal: Journal) -> None:
    journal.put_cluster(PLAN, NOW_S)
    names = [journal.next_machine("c")]
    journal.unwant("c", "test", NOW_S)
    journal.put_cluster(PLAN, NOW_S)
    assert [*names, journal.next_machine("c")] == ["m1", "m2"]


def test_a_new_plan_of_a_cluster_that_is_up_does_not_restart_it(journal: Journal) -> None:
    journal.put_cluster(PLAN, NOW_S)
    journal.put_cluster(replace(PLAN, machines=(SPOT,)), NOW_S + 5)
    assert journal.cluster("c").begun_unix_s == NOW_S
    assert len(journal.cluster("c").plan.machines) == 1


def test_an_unknown_cluster_is_reported_with_the_known_ones(journal: Journal) -> None:
    journal.put_cluster(PLAN, NOW_S)
    with pytest.raises(LocalError, match="there are c"):
        journal.cluster("d")


def test_events_are_reported_in_order_and_once(journal: Journal) -> None:
    journal.put_cluster(PLAN, NOW_S)
    journal.put(record("m1"), NOW_S, "requested", "east")
    journal.unwant("c", "idle", NOW_S)
    journal.unwant("c", "again", NOW_S)
    events = journal.events("c")
    assert [each.what for each in events] == ["wanted", "requested", "down"]
    assert journal.events("c", after=events[1].id) == events[2:]
    assert journal.events(last=1) == events[2:]


def test_a_journal_that_cannot_be_read_may_be_tried_again(journal: Journal, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "journal.sqlite3") as file:
        file.execute("DROP TABLE clusters")
    file.close()
    with pytest.raises(StoreError):
        journal.clusters()


def test_a_journal_of_an_earlier_version_is_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "old.sqlite3"
    with sqlite3.connect(path) as file:
        file.execute(
            "CREATE TABLE events (id INTEGER PRIMARY KEY AUTOINCREMENT, unix_s REAL NOT NULL, cluster TEXT NOT NULL,"
            " machine TEXT NOT NULL, what TEXT NOT NULL, detail TEXT NOT NULL) STRICT"
        )
        file.execute("INSERT INTO events (unix_s, cluster, machine, what, detail) VALUES (1, 'c', 'm1', 'up', '')")
    file.close()
    journal = Journal(path)
    journal.write_event(NOW_S, "c", "m1", "preempted", since_unix_s=NOW_S - 1)
    assert [(each.what, each.since_unix_s) for each in journal.events()] == [("up", None), ("preempted", NOW_S - 1)]
    journal.close()
