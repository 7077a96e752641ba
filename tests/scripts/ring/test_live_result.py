"""Result of the reports of live nodes."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from ring.options import Options
from ring.result import Heard, Result, rows
from ring.table import summary, table

CHATTER = {"topic": "/chatter", "type": "std_msgs/msg/String"}
LATENCY = {"median": 3.0, "p99": 9.0, "max": 9.5}
CALLER = {"calls": 3, "answered": 3, "right": 3, "bytes": 120, "latency_ms": LATENCY}
CARRIED = {**CHATTER, "received": 4, "duplicated": 0, "parts": 1, "hops": 5, "hops_seen": [5], "latency_ms": {}}
SENT = ["aa", "bb", "cc"]


def result(heard: list[str] = SENT, served: int = 3, **caller: object) -> Result:
    talker = {**CHATTER, "bytes": 99, "sent": SENT}
    listener = {"topics": [{**CHATTER, "heard": heard, "latency_ms": LATENCY}]}
    said = Heard((talker,), {"served": served}, listener, {**CALLER, **caller})
    return Result(rows(said, [CARRIED]), Options(live="ros2").settings())


def test_a_live_run_passes_when_all_was_heard_and_answered() -> None:
    topic, lamp = result().topics
    assert result().passed
    assert (topic.journey.latency_ms["median"], topic.journey.hops) == (3.0, 5)
    assert (lamp.comparison.messages, lamp.comparison.delivered, lamp.journey.latency_ms["max"]) == (3, 3, 9.5)


@pytest.mark.parametrize(
    ("heard", "fault"),
    [
        (["aa", "cc"], "/chatter: 1 lost"),
        (["aa", "bb", "bb", "cc"], "/chatter: 1 duplicated"),
        (["aa", "bb", "cc", "dd"], "/chatter: 1 with other bytes than were sent"),
        (["aa", "cc", "bb"], "/chatter: out of order"),
    ],
)
def test_what_was_heard_otherwise_than_said_is_a_fault(heard: list[str], fault: str) -> None:
    assert result(heard).faults == [fault]


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        ({"answered": 2, "right": 2}, "/lamp: 1 calls without an answer"),
        ({"right": 2}, "/lamp: 1 wrong answers"),
        ({"served": 4}, "/lamp: 1 served twice"),
    ],
)
def test_a_call_that_went_otherwise_is_a_fault(said: dict[str, int], fault: str) -> None:
    assert result(**said).faults == [fault]  # type: ignore[arg-type]


def test_the_table_tells_topics_and_services_apart() -> None:
    reported = io.StringIO()
    Console(file=reported, width=200).print(table(result()))
    assert "live ros2" in reported.getvalue()
    assert summary(result()).endswith("3 messages on 1 topics, all identical; 3 calls, all answered.")
    assert [row["kind"] for row in result().to_json()["topics"]] == ["topic", "service"]  # type: ignore[attr-defined]
