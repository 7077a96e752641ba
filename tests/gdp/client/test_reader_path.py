"""Paths to readers: what is never confirmed does not fill the window for ever, and a path begins small."""

from __future__ import annotations

import pytest

from gdp.client.reader_path import ReaderPaths
from gdp.congestion.controller import PathController

MTU, READER = 1_500, b"r" * 32
TRIP_S, STEP_S = 0.01, 0.05


def test_a_flight_that_is_never_confirmed_is_forgotten_though_others_are() -> None:
    paths, now_s = ReaderPaths(), 10.0
    path = paths.path(READER, now_s)
    path.tree_stands(MTU)
    path.sent(
        20 * MTU, 20, now_s
    )  # the lost end of an image: nothing newer of its topic may leave, nothing confirms it
    freed = []
    for _ in range(20):
        number = path.sent(100, 1, now_s)
        path.acknowledged([number], 0, 0.0, now_s + TRIP_S)
        now_s += STEP_S
        freed.append(paths.handle_timer(now_s))
    assert not path.is_silent
    assert path.controller.rate.inflight == 0
    assert freed.count(True) == 1  # a sender that waits learns that it may carry more


def test_another_path_begins_with_no_larger_window_than_the_one_before_it() -> None:
    path = ReaderPaths().path(READER, 10.0)
    path.tree_stands(MTU)
    path.controller.timed_out(10.0)
    thin = path.controller.window
    path.controller.path_changed(11.0)
    assert path.controller.window == thin == 2 * MTU


def test_what_left_by_another_switch_before_a_tree_reached_it_does_not_fill_the_window() -> None:
    paths, now_s = ReaderPaths(), 10.0
    path = paths.path(READER, now_s)
    paths.tree_stands([READER], MTU)
    path.acknowledged([path.sent(MTU, 1, now_s)], 0, 0.0, now_s + TRIP_S)
    paths.attachment_changed(now_s + TRIP_S)
    for stands in (True, False):  # a tree that is renewed frees nothing
        path.sent(20 * MTU, 20, now_s + TRIP_S)
        assert path.allowance(now_s + TRIP_S) == 0
        paths.tree_stands([READER], MTU)
        assert (path.allowance(now_s + TRIP_S) > 0) is stands


def test_the_lost_end_of_a_full_window_lets_one_frame_out_whose_report_frees_it() -> None:
    paths, now_s = ReaderPaths(), 10.0
    path = paths.path(READER, now_s)
    path.tree_stands(MTU)
    path.acknowledged([path.sent(MTU, 1, now_s)], 0, 0.0, now_s + TRIP_S)
    path.sent(100 * MTU, 100, now_s + TRIP_S)
    assert path.allowance(now_s + TRIP_S) == 0
    now_s += TRIP_S + 2 * STEP_S + 0.01
    assert paths.handle_timer(now_s)
    assert path.allowance(now_s) == MTU
    assert path.next_send_s() <= now_s
    probe = path.sent(MTU, 1, now_s)
    assert path.allowance(now_s) == 0, "there is one such frame"
    path.acknowledged([probe], 0, 0.0, now_s + TRIP_S)
    assert paths.handle_timer(now_s + 0.1)
    assert path.controller.rate.inflight == 0
    assert not path.is_silent


def test_timeouts_that_follow_each_other_double_until_a_round_trip_is_measured() -> None:
    paths, now_s = ReaderPaths(), 10.0
    path = paths.path(READER, now_s)
    path.tree_stands(MTU)
    begun_s, timeouts = now_s, list[float]()
    while now_s < begun_s + 12:
        if not path.controller.rate.inflight:
            paths.path(READER, now_s).sent(MTU, 1, now_s)
            path.is_silent = False
        now_s += STEP_S
        paths.handle_timer(now_s)
        if path.is_silent:
            timeouts.append(now_s)
    waits = [round(after - before, 1) for before, after in zip([begun_s, *timeouts], timeouts, strict=False)]
    assert waits[:6] == [0.3, 0.6, 1.2, 2.4, 2.4, 2.4]
    assert path.patience_s(now_s) == pytest.approx(now_s - begun_s)
    path.acknowledged([path.sent(MTU, 1, now_s)], 0, 0.0, now_s + TRIP_S)
    assert path.patience_s(now_s + TRIP_S) == pytest.approx(TRIP_S)


def test_a_reader_node_that_restarted_has_a_new_path_at_once() -> None:
    paths, now_s = ReaderPaths(), 10.0
    path = paths.path(READER, now_s)
    path.tree_stands(MTU)
    fresh = PathController(MTU).window
    paths.note_incarnation(READER, 1_000, now_s)
    for _ in range(3):  # it was killed: timeout after timeout
        path.sent(2 * MTU, 2, now_s)
        now_s += 3
        paths.handle_timer(now_s)
    assert path.is_silent
    assert path.controller.window == 2 * MTU
    path.sent(2 * MTU, 2, now_s)
    for started in (1_000, 999):  # the same incarnation, and one of before
        paths.note_incarnation(READER, started, now_s)
        assert path.is_silent
    paths.note_incarnation(READER, 1_001, now_s)
    assert not path.is_silent
    assert not path.controller.rate.inflight
    assert path.controller.window == fresh
    assert paths.is_former(READER, 1_000)
    assert not paths.is_former(READER, 1_001)
    assert not paths.is_former(READER, 0), "not known when it started"
    paths.path(READER, now_s).sent(MTU, 1, now_s)
    paths.handle_timer(now_s + 0.35)
    assert path.is_silent, "the first timeout of a new path is not doubled"


def test_a_reader_is_behind_when_frames_wait_in_its_own_socket() -> None:
    path = ReaderPaths().path(READER, 10.0)
    path.handle_held(0.5)
    assert not path.is_behind, "one report may be late for another reason"
    path.handle_held(0.5)
    assert path.is_behind
    path.handle_held(0.02)
    assert not path.is_behind


def test_what_leaves_while_another_path_governs_delays_this_one_for_a_moment_only() -> None:
    path, now_s = ReaderPaths().path(READER, 10.0), 10.0
    path.tree_stands(MTU)
    path.controller.timed_out(now_s)
    for _ in range(600):  # 30 MB to all readers, while this one does not govern
        path.sent(50_000, 34, now_s)
        now_s += 0.01
    path.controller.rate.forget_before()
    assert path.next_send_s() <= now_s + 0.25
    assert path.allowance(now_s + 0.25) > 0
