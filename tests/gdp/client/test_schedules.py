"""Schedules of Heartbeats and reports: what is repeated becomes rarer while no answer can have come."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Final, cast

import pytest

from gdp.client.ack_nack_schedule import AckNackSchedule
from gdp.client.heartbeat_schedule import HeartbeatSchedule
from gdp.limits import REPORT_DELAY_S
from gdp.message.heartbeat import Heartbeat

if TYPE_CHECKING:
    from gdp.message.reassembly import Reassembler

PLACE: Final = Heartbeat(
    oldest=0,
    sent_number=0,
    sent_part=0,
    starts={},
    description=b"",
    moves=(),
    oldest_sequence=0,
    sent_sequence=0,
    gone=(),
)


def heartbeats_s(trip_s: float, duration_s: float, *, is_reminder: bool) -> list[float]:
    """Return when Heartbeats leave that are wanted all the time."""
    schedule, sent_s = HeartbeatSchedule(b"", 0), list[float]()
    for step in range(round(duration_s / 0.01)):
        now_s = step * 0.01
        schedule.wanted, schedule.is_reminder_wanted = not is_reminder, is_reminder
        if schedule.is_due(now_s):
            schedule.poll_heartbeat(PLACE, now_s, trip_s)
            sent_s.append(now_s)
    return sent_s


@pytest.mark.parametrize(("trip_s", "count"), [(0.0, 50), (0.1, 10), (0.5, 2), (60.0, 1)])
def test_there_is_one_reminder_in_a_round_trip(trip_s: float, count: int) -> None:
    assert len(heartbeats_s(trip_s, 1.0, is_reminder=True)) == pytest.approx(count, rel=0.1)


def test_a_reminder_waits_no_longer_than_a_second() -> None:
    assert heartbeats_s(60.0, 2.5, is_reminder=True) == pytest.approx([0, 1, 2])


def test_what_is_new_does_not_wait_for_a_round_trip() -> None:
    assert len(heartbeats_s(60.0, 1.0, is_reminder=False)) == pytest.approx(50, rel=0.1)


def test_a_reminder_that_waits_has_a_timer() -> None:
    schedule = HeartbeatSchedule(b"", 0)
    schedule.poll_heartbeat(PLACE, 1.0, 0.3)
    assert schedule.get_timer() == float("inf")
    schedule.is_reminder_wanted = True
    assert schedule.get_timer() == pytest.approx(1.3)


def test_what_stays_missing_while_nothing_comes_is_requested_ever_less_often() -> None:
    schedule, now_s, waits = AckNackSchedule(cast("Reassembler", SimpleNamespace()), 0.0), 0.0, list[float]()
    for _ in range(7):
        schedule.start_report()
        schedule.handle_reported(now_s, is_missing=True)
        waits.append((schedule.due_s - now_s) / REPORT_DELAY_S)
        now_s = schedule.due_s
    assert waits == pytest.approx([2, 4, 8, 16, 16, 16, 16])
    schedule.count(100, 1, (), 1, 0, now_s)
    schedule.start_report()
    schedule.handle_reported(now_s, is_missing=True)
    assert schedule.due_s - now_s == pytest.approx(REPORT_DELAY_S)
