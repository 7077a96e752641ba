"""Silent flows to which messages are due."""

from __future__ import annotations

from ring.silence import REPORTED_FROM_S, Silence


def test_a_flow_that_has_everything_is_not_silent() -> None:
    silence = Silence()
    silence.sent("/a", 5, 0.0)
    silence.received("/a", 5, 0.1)
    assert (silence.silent(60.0), silence.behind) == ([], 0)


def test_a_flow_that_is_owed_something_is_silent_from_when_it_was_sent() -> None:
    silence = Silence()
    silence.sent("/a", 5, 0.0)
    silence.received("/a", 5, 0.1)
    silence.sent("/a", 6, 20.0)
    silence.sent("/a", 9, 21.0)
    assert silence.silent(20.0 + REPORTED_FROM_S - 0.1) == []
    assert silence.silent(24.0) == [("/a", 4.0)]
    assert silence.behind == 1  # of the report before; three more may be under way
    silence.sent("/a", 9, 21.5)
    assert silence.behind == 4


def test_whatever_comes_ends_a_silence_and_the_longest_is_remembered() -> None:
    silence = Silence()
    silence.sent("/a", 5, 0.0)
    silence.received("/a", 1, 3.0)
    assert silence.silent(3.0) == []
    silence.received("/a", 1, 5.0)
    assert silence.silent(5.0) == [("/a", 2.0)]
    assert silence.longest_s == 3.0


def test_the_longest_silence_comes_first() -> None:
    silence = Silence()
    silence.sent("/a", 1, 4.0)
    silence.sent("/b", 1, 0.0)
    assert silence.silent(10.0) == [("/b", 10.0), ("/a", 6.0)]
