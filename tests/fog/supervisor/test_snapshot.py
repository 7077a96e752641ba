"""Snapshot of a supervisor for the live view."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fog.supervisor.core.record import Outcome
from fog.supervisor.journal import Journal
from fog.supervisor.snapshot import supervisor_snapshot
from tests.fog.supervisor.machines import NOW_S, record, serving
from tests.fog.supervisor.test_journal import PLAN


def test_a_snapshot_has_the_clusters_that_are_up_their_machines_and_the_latest_events(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.sqlite3")
    journal.put_cluster(PLAN, NOW_S)
    journal.put(serving("m1"), NOW_S, "serving", "east")
    journal.put(record("m2"), NOW_S)
    journal.put(serving("m3").ended(Outcome.PREEMPTED, "preempted", NOW_S), NOW_S)
    shown: Any = json.loads(json.dumps(supervisor_snapshot(journal)))
    (cluster,) = shown["clusters"]
    assert (shown["role"], cluster["name"], cluster["wanted"], cluster["serving"]) == ("supervisor", "c", 2, 1)
    assert (cluster["machines"][0]["name"], cluster["machines"][0]["stage"]) == ("m1", "serving")
    assert len(cluster["machines"]) == 2
    assert shown["events"][-1] == {"unix_s": NOW_S, "cluster": "c", "text": "c m1: serving, east"}
    journal.unwant("c", "test", NOW_S)
    assert supervisor_snapshot(journal)["clusters"] == []
    journal.close()


def test_a_snapshot_of_an_unchanged_cluster_is_the_same_a_minute_later(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.sqlite3")
    journal.put_cluster(PLAN, NOW_S)
    journal.put(serving("m1"), NOW_S)
    assert supervisor_snapshot(journal) == supervisor_snapshot(journal)
    journal.close()
