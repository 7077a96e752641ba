"""Silent flows to which messages are due."""

from __future__ import annotations

from ring.traffic import REPORTED_FROM_S, Traffic


def test_a_flow_that_has_everything_is_not_silent() -> None:
    traffic = Traffic()
    traffic.note_sent("/a", 5, 0.0)
    traffic.note_received("/a", 5, 0.1)
    assert (traffic.silent(60.0), traffic.behind) == ([], 0)


def test_a_flow_that_is_owed_something_is_silent_from_when_it_was_sent() -> None:
    traffic = Traffic()
    traffic.note_sent("/a", 5, 0.0)
    traffic.note_received("/a", 5, 0.1)
    traffic.note_sent("/a", 6, 20.0)
    traffic.note_sent("/a", 9, 21.0)
    assert traffic.silent(20.0 + REPORTED_FROM_S - 0.1) == []
    assert traffic.silent(24.0) == [("/a", 4.0)]
    assert traffic.behind == 1  # of the report before; three more may be under way
    traffic.note_sent("/a", 9, 21.5)
    assert traffic.behind == 4


def test_whatever_comes_ends_a_silence_and_the_longest_is_remembered() -> None:
    traffic = Traffic()
    traffic.note_sent("/a", 5, 0.0)
    traffic.note_received("/a", 1, 3.0)
    assert traffic.silent(3.0) == []
    traffic.note_received("/a", 1, 5.0)
    assert traffic.silent(5.0) == [("/a", 2.0)]
    assert traffic.longest_s == 3.0


def test_the_longest_silence_comes_first() -> None:
    traffic = Traffic()
    traffic.note_sent("/a", 1, 4.0)
    traffic.note_sent("/b", 1, 0.0)
    assert traffic.silent(10.0) == [("/b", 10.0), ("/a", 6.0)]
