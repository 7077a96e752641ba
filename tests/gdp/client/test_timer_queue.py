"""Timer queue: it examines only changed timers, and returns the same next timer as a full scan."""

from __future__ import annotations

from random import Random

import pytest

from gdp.client.timer_queue import TimerQueue


class Clock:
    """Timer that counts how often it was queried."""

    def __init__(self, due_s: float | None = None) -> None:
        self.due_s = due_s
        self.asked = 0

    def get_timer(self) -> float | None:
        self.asked += 1
        return self.due_s


def timers_of(*clocks: Clock) -> TimerQueue[Clock]:
    timers = TimerQueue[Clock]()
    for clock in clocks:
        timers.touched[clock] = None
    return timers


@pytest.mark.parametrize("seed", range(10))
def test_whatever_is_put_off_or_brought_forward_the_first_is_known_and_none_is_missed(seed: int) -> None:
    chance, now_s = Random(seed), 0.0
    clocks = [Clock() for _ in range(12)]
    timers = timers_of(*clocks)
    for _ in range(500):
        clock = chance.choice(clocks)
        clock.due_s = chance.choice((None, now_s + chance.random(), now_s + 10 * chance.random()))
        timers.touched[clock] = None
        due = [each.due_s for each in clocks if each.due_s is not None]
        assert timers.next_due() == min(due, default=float("inf"))
        if chance.random() < 0.2:
            now_s += chance.random()
            fired = [each for each in clocks if each.due_s is not None and each.due_s <= now_s]
            assert sorted(timers.poll_due(now_s), key=clocks.index) == fired
            for each in fired:
                each.due_s = None


def test_those_that_were_not_touched_are_not_asked() -> None:
    idle, busy = [Clock(50.0 + at) for at in range(100)], Clock(1.0)
    timers = timers_of(*idle, busy)
    timers.next_due()
    for at in range(40):
        busy.due_s = 1.0 + at
        timers.touched[busy] = None
        assert timers.next_due() == busy.due_s
    assert [clock.asked for clock in idle] == [1] * 100


def test_one_that_is_due_again_and_again_leaves_nothing_behind() -> None:
    clock = Clock(0.0)
    timers = timers_of(clock)
    for at in range(1_000):
        clock.due_s = 1_000.0 - at / 2  # always sooner than the time before
        timers.touched[clock] = None
        timers.next_due()
    clock.due_s = float("inf")
    timers.touched[clock] = None
    assert timers.next_due() == float("inf")
    assert [len(each) for each in (timers._queue, timers._queue._heap, timers.touched)] == [0, 0, 0]


def test_a_timer_that_fired_is_queried_again() -> None:
    clock = Clock(1.0)
    timers = timers_of(clock)
    assert timers.poll_due(0.5) == []
    assert timers.poll_due(1.0) == [clock]
    clock.due_s = 2.0
    assert timers.next_due() == 2.0
