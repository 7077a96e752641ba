"""Paces of readers: who gets one, and which messages are for whom."""

from __future__ import annotations

import pytest

from gdp.client.reader_paces import ReaderPaces
from gdp.client.reader_path import ReaderPaths
from gdp.client.send_options import SendOptions
from gdp.limits import PACE_MAX
from tests.gdp.client.pipe import Pipe, publisher_of

FAST, MEDIUM, THIN = (bytes([each]) * 32 for each in (1, 2, 3))
ALL = [FAST, MEDIUM, THIN]
MBIT_S = {FAST: 100.0, MEDIUM: 5.0, THIN: 1.0}
IMAGE_BYTES = 30_000


def measured() -> tuple[ReaderPaths, ReaderPaces]:
    """Return paths whose rates are known, and the paces of their readers."""
    paths = ReaderPaths()
    for name, mbit_s in MBIT_S.items():
        model = paths.path(name, 0.0).controller.model
        model.add_rtt(0.02, 0.0)
        model.add_rate(mbit_s * 1e6 / 8, 0, 0.0, is_full=True)
    return paths, ReaderPaces(paths)


def stated() -> tuple[ReaderPaths, ReaderPaces, dict[bytes, int]]:
    """Return the same once the slower two have stated the paces that they were given."""
    paths, paces = measured()
    for at_s in (0.0, 0.1):
        for name in (MEDIUM, THIN):
            paths.path(name, at_s)
        hold_back(paths, paces, MEDIUM, THIN)
    given = dict(paces.to_state())
    for name, pace in given.items():
        assert not paces.handle_report(name, pace, 1.0)
    return paths, paces, given


def hold_back(paths: ReaderPaths, paces: ReaderPaces, *names: bytes) -> None:
    """Let readers hold back the others for a while."""
    for name in names:
        paths.path(name, 0.0).sent(10_000_000, 1, 0.0)
    for at_s in (0.0, 0.3, 0.6):
        paces.record(ALL, 0, at_s)
    paces.slow_down(0.6)
    for name in names:
        paths.path(name, 0.0).controller.rate.forget_all()


def test_readers_that_hold_back_others_get_the_paces_of_their_rates() -> None:
    _, paces, given = stated()
    assert given.keys() == {MEDIUM, THIN}
    assert 0 < given[THIN] < given[MEDIUM] < PACE_MAX
    assert paces.governing(ALL) == [FAST]
    assert paces.to_state() == ()


def test_no_reader_is_slowed_down_once_all_that_is_published_leaves_in_time() -> None:
    paths, paces = measured()
    paths.path(THIN, 0.0).sent(10_000_000, 1, 0.0)
    paces.record(ALL, 0, 0.0)
    paces.slowing.blocks.clear()
    paces.record(ALL, 0, 0.4)
    assert not paces.slow_down(0.6)


def test_a_reader_whose_path_permits_a_little_at_each_turn_holds_back_the_others_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    publisher = publisher_of(reliable=False, options=SendOptions(own_pace=True))
    pipe = Pipe(publisher)
    fast, thin = (pipe.join(name).reader.name for name in (FAST, THIN))
    assert pipe.run(1.0, lambda: len(publisher.matched.active) == 2)
    for name, allowance in ((fast, 15_000), (thin, 3_000)):
        path = publisher.governing_paths._paths.path(name, pipe.now_s)
        path.controller.model.add_rate(allowance * 100.0, 0, pipe.now_s, is_full=True)
        monkeypatch.setattr(path, "allowance", lambda *_, allowance=allowance, **__: allowance)
    for _ in range(3):
        publisher.publish(bytes(IMAGE_BYTES))
        for _ in range(3):
            now_s = pipe.now_s = pipe.now_s + 0.08
            allowance = publisher.governing_paths.allowance(now_s)
            assert 0 < allowance <= sum(map(len, publisher.poll_frames(now_s, allowance))) + 1_500
            publisher.handle_timer(now_s)
    assert [name for name, _ in publisher.governing_paths.paces.to_state()] == [thin]


def test_a_message_is_for_all_whose_paths_are_free_for_it() -> None:
    paths, paces, given = stated()
    assert paces.pace_for(ALL, IMAGE_BYTES) == 0
    paces.begin_turn()
    paths.path(THIN, 1.0).sent(IMAGE_BYTES, 1, 1.0)
    assert paces.pace_for(ALL, IMAGE_BYTES) == given[MEDIUM]
    paths.path(MEDIUM, 1.0).sent(10 * IMAGE_BYTES, 1, 1.0)
    assert paces.pace_for(ALL, IMAGE_BYTES) == PACE_MAX
    assert paces.withheld == 2


def test_a_path_that_other_topics_keep_full_starves_no_topic() -> None:
    paths, paces, given = stated()
    own = {THIN}
    paces.is_under_way = own.__contains__
    paths.path(THIN, 1.0).sent(10 * IMAGE_BYTES, 1, 1.0)
    assert paces.pace_for(ALL, IMAGE_BYTES) == given[MEDIUM]
    own.clear()  # what is left are frames of others
    paces.begin_turn()
    assert paces.pace_for(ALL, IMAGE_BYTES) == 0
    assert paces.pace_for(ALL, IMAGE_BYTES) == given[MEDIUM]


def test_messages_that_begin_at_once_are_not_all_for_the_slow_reader() -> None:
    _, paces, given = stated()
    assert [paces.pace_for(ALL, IMAGE_BYTES) for _ in range(2)] == [0, given[MEDIUM]]


def test_a_silent_reader_holds_back_no_slower_one() -> None:
    paths, paces, _ = stated()
    paths.path(MEDIUM, 1.0).sent(10 * IMAGE_BYTES, 1, 1.0)
    paths.path(MEDIUM, 1.0).is_silent = True
    assert paces.pace_for(ALL, IMAGE_BYTES) == 0


def test_without_the_fastest_reader_the_next_one_governs() -> None:
    paths, paces, _ = stated()
    assert paces.governing([MEDIUM, THIN]) == [MEDIUM]
    paths.path(FAST, 1.0).is_silent = True
    assert paces.governing(ALL) == [MEDIUM]


def test_a_reader_whose_queue_holds_no_message_governs_again() -> None:
    paths, paces, given = stated()
    paths.path(THIN, 1.0).controller.model.loss = 0.3
    assert paces.handle_report(THIN, given[THIN], 5.0)
    assert paces.to_state() == ((THIN, PACE_MAX),)
    paces.handle_report(THIN, PACE_MAX, 5.1)
    assert paces.governing(ALL) == [FAST, THIN]


def test_a_pace_that_was_not_given_is_taken_back() -> None:
    _, paces = measured()
    assert paces.handle_report(THIN, 7, 1.0)
    assert paces.to_state() == ((THIN, PACE_MAX),)


def test_parity_is_for_those_that_lose_frames() -> None:
    paths, paces, given = stated()
    paths.path(MEDIUM, 1.0).controller.model.loss = 0.02
    assert paces.pace_of_lossy(ALL, 0.001) == given[MEDIUM]
    assert paces.pace_of_lossy(ALL, 0.1) == 0
