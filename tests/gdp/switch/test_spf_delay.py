"""Pacing of path computation, and damping of links that flap."""

from __future__ import annotations

from itertools import product

import pytest

from gdp.names import Name
from gdp.switch.damping import Damping
from gdp.switch.spf_delay import HOLD_DOWN_S, TIME_TO_LEARN_S, TRANSITIONS, SpfDelay, SpfEvent, SpfState

LINK = (1, Name(b"n" * 32))


def delay_after(spf: SpfDelay, now_s: float) -> float:
    """Return the delay from news to path computation, and compute the paths."""
    spf.record_change(now_s)
    assert spf.due_s is not None
    delay_s = spf.due_s - now_s
    spf.computed()
    return delay_s


def test_every_state_answers_every_event() -> None:
    assert set(TRANSITIONS) == set(product(SpfState, SpfEvent))


@pytest.mark.parametrize("state", list(SpfState))
def test_quiet_comes_back_from_everywhere(state: SpfState) -> None:
    assert TRANSITIONS[state, SpfEvent.HELD_DOWN] is SpfState.QUIET


def test_the_first_news_are_followed_at_once_and_later_ones_less_and_less_often() -> None:
    spf = SpfDelay()
    assert delay_after(spf, 10.0) == pytest.approx(0.005)
    assert delay_after(spf, 10.1) == pytest.approx(0.05)
    assert delay_after(spf, 10.0 + TIME_TO_LEARN_S) == pytest.approx(0.3)
    assert delay_after(spf, 11.0) == pytest.approx(0.3)


def test_news_after_a_quiet_time_are_followed_at_once_again() -> None:
    spf = SpfDelay()
    delay_after(spf, 10.0)
    delay_after(spf, 11.0)
    assert delay_after(spf, 11.0 + HOLD_DOWN_S) == pytest.approx(0.005)


def test_news_while_paths_wait_to_be_computed_put_nothing_off() -> None:
    spf = SpfDelay()
    spf.record_change(10.0)
    spf.record_change(10.004)
    assert spf.due_s == pytest.approx(10.0 + 0.005)


def test_a_loss_waits_no_longer_than_the_short_delay_even_behind_other_news() -> None:
    spf = SpfDelay()
    delay_after(spf, 10.0)
    spf.record_change(11.0)
    assert spf.due_s == pytest.approx(11.3)
    spf.record_change(11.1, is_loss=True)
    assert spf.due_s == pytest.approx(11.15)
    spf.record_change(11.12, is_loss=True)
    assert spf.due_s == pytest.approx(11.15)


def test_a_link_that_went_once_or_twice_is_used_at_once() -> None:
    damping = Damping()
    for now_s in (0.0, 1.0, 2.0):
        damping.went(LINK, now_s)
        assert not damping.suppresses(LINK)


def test_a_link_that_flaps_waits_until_it_has_stayed_and_no_longer_than_ten_seconds() -> None:
    damping = Damping()
    for flap in range(100):
        damping.went(LINK, flap * 0.1)
    assert damping.suppresses(LINK)
    reuse_s = damping.next_reuse()
    assert reuse_s is not None
    assert 10.0 < reuse_s <= 20.0
    damping.expire(reuse_s - 0.1)
    assert damping.suppresses(LINK)
    damping.expire(reuse_s)
    assert not damping.suppresses(LINK)
    assert damping.next_reuse() is None


def test_a_link_that_goes_every_five_seconds_is_never_left_out() -> None:
    damping = Damping()
    for flap in range(100):
        damping.went(LINK, flap * 5.0)
        assert not damping.suppresses(LINK)
