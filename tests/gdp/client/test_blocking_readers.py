"""Readers that hold back the others: hopeless ones no longer count, busy ones do."""

from __future__ import annotations

import pytest

from gdp.client.blocking_readers import PROGRESS_BYTES, BlockingReaders, PathState

SLOW, FAST = b"s" * 32, b"f" * 32
LAG_S, STEP_S = 6.0, 0.1


def held_back(blocked_of_step: float, path_bytes_s: float, fast_allowance: int = 1_500) -> list[bytes]:
    """Return what is slow after the lag; the path to ``SLOW`` permits nothing for a part of each step."""
    blocks, now_s = BlockingReaders(LAG_S), 10.0
    due_s = now_s + LAG_S
    while now_s < due_s:
        sent = round((now_s - 10.0) * path_bytes_s)
        blocks.record([PathState(SLOW, 0, sent), PathState(FAST, fast_allowance, 0)], now_s)
        later_s = now_s + blocked_of_step * STEP_S
        blocks.record([PathState(SLOW, 1_500, sent), PathState(FAST, 1_500, 0)], later_s)
        now_s += STEP_S
    if blocks.blocks:
        assert blocks.get_timer() == pytest.approx(due_s)
        assert blocks.slow(due_s - 0.01) == []
    return blocks.slow(due_s + 0.001)


@pytest.mark.parametrize(
    ("blocked", "path_bytes_s", "is_slow"),
    [
        (0.9, 10_000, True),  # 60 kB in the lag: the others wait for a path that carries next to nothing
        (0.2, 10_000, False),  # each message waits for a moment, as behind another topic
        (0.9, PROGRESS_BYTES / LAG_S * 1.1, False),  # other topics fill the path, so it is busy, not slow
    ],
)
def test_a_reader_is_slow_when_its_path_alone_holds_back_the_others_and_carries_little(
    blocked: float, path_bytes_s: float, is_slow: bool
) -> None:
    assert held_back(blocked, path_bytes_s) == ([SLOW] if is_slow else [])


def test_no_reader_is_slow_where_several_paths_are_full() -> None:
    assert held_back(0.9, 10_000, fast_allowance=0) == []


def test_what_waits_without_a_break_counts_as_blocked_up_to_now() -> None:
    blocks = BlockingReaders(LAG_S)
    blocks.record([PathState(SLOW, 0, 0), PathState(FAST, 1_500, 0)], 10.0)
    assert blocks.slow(10.0 + LAG_S) == [SLOW]
    assert not blocks.blocks


def test_a_reader_that_is_left_alone_holds_back_no_other() -> None:
    blocks = BlockingReaders(LAG_S)
    blocks.record([PathState(SLOW, 0, 0), PathState(FAST, 1_500, 0)], 10.0)
    blocks.record([PathState(SLOW, 0, 0)], 11.0)  # the other is silent
    assert blocks.slow(10.0 + LAG_S) == []


def test_a_reader_that_falls_silent_holds_back_no_other() -> None:
    blocks = BlockingReaders(LAG_S)
    blocks.record([PathState(SLOW, 0, 0), PathState(FAST, 1_500, 0)], 10.0)
    for step in range(50):  # it is cut off, so it does not govern
        blocks.record([PathState(FAST, 1_500, 0)], 11.0 + step * STEP_S)
    assert blocks.slow(10.0 + LAG_S) == []
