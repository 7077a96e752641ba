"""Result of the ring: passed or failed, and its printed form."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from rich.console import Console

from lab.process import Event
from proxy.recordings.compare import TopicComparison
from ring.options import Options
from ring.result import Journey, Result, put_together
from ring.table import hops_in_words, summary, table
from tests.pages import ROOT

GOOD = TopicComparison(
    topic="/imu",
    type_name="sensor_msgs/msg/Imu",
    messages=1_000,
    bytes=324_000,
    delivered=1_000,
    lost=0,
    duplicated=0,
    altered=0,
    identical=True,
    in_order=True,
)
REPORT: Event = {
    "topic": "/imu",
    "type": "sensor_msgs/msg/Imu",
    "received": 1_000,
    "lost": 0,
    "duplicated": 0,
    "latency_ms": {"median": 0.5, "p99": 2, "max": 9.25},
    "parts": 1,
    "hops": 5,
    "hops_seen": [5, 2],
}
SETTINGS = Options().settings()


def result(comparison: TopicComparison = GOOD, report: Event = REPORT, **more: object) -> Result:
    return Result(put_together([comparison], [report]), SETTINGS, **more)  # type: ignore[arg-type]


def test_a_run_passes_when_all_came_out_identical_and_in_order() -> None:
    assert result().passed


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ({"lost": 2, "delivered": 998, "identical": False}, "/imu: 2 lost"),
        ({"duplicated": 1}, "/imu: 1 duplicated"),
        ({"altered": 1, "identical": False}, "/imu: 1 with other bytes than were sent"),
        ({"in_order": False}, "/imu: out of order"),
        ({"messages": 0, "delivered": 0}, "no message was sent"),
    ],
)
def test_a_run_does_not_pass_with_a_single_fault(wrong: dict[str, int], fault: str) -> None:
    bad = result(replace(GOOD, **wrong))  # type: ignore[arg-type]
    assert not bad.passed
    assert bad.faults == [fault]


def test_what_the_receiver_had_twice_counts_though_it_was_recorded_once() -> None:
    assert result(report={**REPORT, "duplicated": 3}).faults == ["/imu: 3 duplicated"]


def test_a_complaint_about_an_end_keeps_a_run_from_passing() -> None:
    assert result(complaints=("the sender ended with code 1",)).faults == ["the sender ended with code 1"]


def test_a_recording_that_ends_in_the_middle_passes_with_a_note() -> None:
    short = result(unread="about 3 messages")
    assert short.passed
    assert "Not all could be read: about 3 messages" in summary(short)


def test_json_has_a_row_for_each_topic() -> None:
    written = result().to_json()
    assert written["passed"] is True
    assert written["settings"] == SETTINGS
    assert written["topics"] == [
        {
            "topic": "/imu",
            "kind": "topic",
            "type": "sensor_msgs/msg/Imu",
            "messages": 1_000,
            "bytes": 324_000,
            "delivered": 1_000,
            "lost": 0,
            "duplicated": 0,
            "identical": True,
            "in_order": True,
            "latency_ms": {"median": 0.5, "p99": 2.0, "max": 9.25},
            "silent_ms": None,
            "parts": 1,
            "hops": 5,
            "hops_seen": [5, 2],
        }
    ]


def test_a_topic_that_the_receiver_never_saw_has_a_row_too() -> None:
    (row,) = put_together([GOOD], [])
    assert row.journey == Journey()


def test_hops_tell_how_many_switches_stood_between() -> None:
    assert hops_in_words(Journey(hops=5)) == "5 (3 between)"
    assert hops_in_words(Journey(hops=5, hops_seen=(5, 2))) == "5 (3 between), also 2"
    assert hops_in_words(Journey()) == "-"


LONG = {"topic": "/robot1/arm/camera/depth/image_rect_raw", "type_name": "control_msgs/action/FollowJointTrajectory"}


def printed(of: Result, width: int, *, is_wide: bool = False) -> list[str]:
    console = Console(width=width)
    with console.capture() as captured:
        console.print(table(of, is_wide=is_wide))
    return captured.get().splitlines()


@pytest.mark.parametrize("more", [{}, LONG, {"messages": 1_000_000, "lost": 999_999}], ids=["short", "long", "many"])
def test_the_table_fits_100_columns_with_every_number_whole(more: dict[str, object]) -> None:
    lines = printed(result(replace(GOOD, **more)), 100)  # type: ignore[arg-type]
    assert max(map(len, lines)) <= 100
    assert not [line for line in lines if "…" in line]
    headings = ["topic", "type", "messages", "lost", "identical", "median ms", "hops"]
    assert re.split(r"  +", lines[1].strip()) == headings


def test_the_wide_table_has_all_columns() -> None:
    heading = printed(result(), 200, is_wide=True)[1]
    assert all(
        each in heading for each in ("bytes", "delivered", "duplicated", "p99 ms", "max ms", "silent ms", "parts")
    )


def test_the_table_shows_topics_whose_names_look_like_markup() -> None:
    console = Console(width=200, record=True, file=None, quiet=True)
    console.quiet = False
    with console.capture() as captured:
        console.print(table(result(replace(GOOD, topic="/a[bold]b"))))
    assert "/a[bold]b" in captured.get()


def test_the_readme_shows_the_table_as_it_is_printed() -> None:
    heading = printed(result(), 100)[1].split("  ")
    shown = next(line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith("topic "))
    assert [each.strip() for each in heading if each.strip()] == [each.strip() for each in shown.split("  ") if each]
