"""Copies of urgent frames: how many, when, and within which budget."""

from __future__ import annotations

import pytest

from gdp.client.redundancy import CopyBudget, Redundancy, sends_for
from gdp.frame.codec import Flag, Header, Kind, encode
from tests.gdp.client.pipe import Pipe, publisher_of

NAME, READER = b"n" * 32, b"r" * 32


def frame(number: int, parts: int = 1, size: int = 200) -> bytes:
    """Return a DATA frame, unsealed."""
    return encode(Header(Kind.DATA, Flag.URGENT, 64, 1, size, number, 0, parts, 1, NAME, NAME)) + bytes(size)


def redundancy() -> Redundancy:
    """Return the redundancy of one publisher with a budget of its own."""
    return Redundancy(budget=CopyBudget(), is_enabled=True)


@pytest.mark.parametrize(
    ("loss", "sends"), [(None, 2), (0.0, 1), (0.001, 1), (0.002, 2), (0.025, 2), (0.03, 3), (0.05, 3), (1.0, 3)]
)
def test_sendings_follow_the_loss(loss: float | None, sends: int) -> None:
    assert sends_for(loss) == sends


def test_copies_leave_apart_and_soon() -> None:
    made = redundancy()
    made.handle_sent([frame(1)], 0.05, None, 10.0)
    assert made.poll_copies(10.0) == []
    times = []
    while (due_s := made.due_s) < float("inf"):
        times.append(due_s - 10.0)
        assert made.poll_copies(due_s) == [frame(1)]
    assert times == pytest.approx([0.004, 0.007])
    assert made.copies == 2


def test_larger_messages_are_not_copied() -> None:
    made = redundancy()
    made.handle_sent([frame(1, parts=2), frame(2, parts=3)], 0.05, None, 0.0)
    assert made.poll_copies(1.0) == [frame(1, parts=2)] * 2


@pytest.mark.parametrize(("loss", "copies"), [(0.05, 1), (0.01, 0)])
def test_two_paths_count_as_two_sendings(loss: float, copies: int) -> None:
    made = redundancy()
    made.handle_sent([frame(1)], loss, None, 0.0, has_pair=True)
    assert len(made.poll_copies(1.0)) == copies


@pytest.mark.parametrize(("path", "share"), [(None, 64_000.0), (10e6, 500_000.0), (1_000.0, 8_000.0)])
def test_copies_take_a_twentieth_of_the_path(path: float | None, share: float) -> None:
    made, size = redundancy(), 0
    for step in range(20_000):
        made.handle_sent([frame(step, size=1_200)] * 2, 0.05, path, step * 0.001)
        size += sum(map(len, made.poll_copies(step * 0.001)))
    assert 0.9 * share < size / 20 < 1.1 * share


def test_topics_share_one_budget() -> None:
    budget = CopyBudget()
    topics = [Redundancy(budget=budget, is_enabled=True) for _ in range(10)]
    size = 0
    for step in range(10_000):
        for each in topics:
            each.handle_sent([frame(step)], None, None, step * 0.001)
            size += sum(map(len, each.poll_copies(step * 0.001)))
    assert size / 10 < 1.1 * 64_000


def test_copies_are_dropped_with_the_last_reader() -> None:
    made = redundancy()
    made.handle_sent([frame(1)], 0.05, None, 0.0)
    made.clear()
    assert made.due_s == float("inf")
    assert made.poll_copies(1.0) == []


@pytest.mark.parametrize("urgent", [True, False])
def test_what_is_not_urgent_is_not_copied(urgent: bool) -> None:
    publisher = publisher_of(urgent=urgent)
    pipe = Pipe(publisher)
    pipe.join(READER)
    assert pipe.run(1, lambda: publisher.readers > 0)
    pipe.publish([b"message"])
    assert pipe.run(0.1, lambda: publisher.protection.copies.copies > 0) is urgent
