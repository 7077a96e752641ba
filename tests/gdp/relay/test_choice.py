"""Choice between tunnel and relay, and the waiting time between attempts."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from gdp.relay.choice import RelayChoice


def test_the_relay_starts_when_no_tunnel_comes_up_at_the_start() -> None:
    choice = RelayChoice(begun_s=100.0)
    assert not choice.update(100.0, is_udp_up=False)
    assert choice.next_due_s() == 105.0
    assert not choice.update(104.9, is_udp_up=False)
    assert choice.update(105.0, is_udp_up=False)


def test_a_tunnel_that_comes_up_in_time_needs_no_relay() -> None:
    choice = RelayChoice(begun_s=0.0)
    assert not choice.update(1.0, is_udp_up=True)
    assert choice.next_due_s() is None
    assert not choice.update(1_000.0, is_udp_up=True)


def test_a_lost_tunnel_starts_the_relay_sooner_than_at_the_start() -> None:
    choice = RelayChoice(begun_s=0.0)
    choice.update(1.0, is_udp_up=True)
    assert not choice.update(50.0, is_udp_up=False)
    assert choice.next_due_s() == 53.0
    assert choice.update(53.0, is_udp_up=False)


def test_the_relay_stays_until_the_tunnel_has_been_stable() -> None:
    choice = RelayChoice(begun_s=0.0)
    assert choice.update(5.0, is_udp_up=False)
    assert choice.next_due_s() is None
    assert choice.update(10.0, is_udp_up=True)
    assert choice.next_due_s() == 40.0
    assert choice.update(39.9, is_udp_up=True)
    assert not choice.update(40.0, is_udp_up=True)


def test_a_break_of_the_tunnel_begins_its_stable_time_again() -> None:
    choice = RelayChoice(begun_s=0.0)
    choice.update(5.0, is_udp_up=False)
    choice.update(10.0, is_udp_up=True)
    choice.update(30.0, is_udp_up=False)
    choice.update(31.0, is_udp_up=True)
    assert choice.update(60.9, is_udp_up=True)
    assert not choice.update(61.0, is_udp_up=True)


@given(st.lists(st.tuples(st.floats(0.01, 20.0), st.booleans()), min_size=1, max_size=60))
def test_the_answer_changes_at_most_once_in_the_damping_time(steps: list[tuple[float, bool]]) -> None:
    choice = RelayChoice(begun_s=0.0)
    now_s, answers = 0.0, [(0.0, False)]
    for wait_s, is_up in steps:
        now_s += wait_s
        answers.append((now_s, choice.update(now_s, is_udp_up=is_up)))
    changes = [(at, to) for (_, before), (at, to) in itertools.pairwise(answers) if before is not to]
    for (started_s, relays), (stopped_s, _) in itertools.pairwise(changes):
        if relays:
            assert stopped_s - started_s >= choice.stable_s - 1e-6
