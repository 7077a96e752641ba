"""Table of the congestion controller's states."""

from __future__ import annotations

from itertools import product

import pytest

from gdp.congestion.states import TRANSITIONS, Signal, State


def test_every_state_answers_every_signal() -> None:
    assert set(TRANSITIONS) == set(product(State, Signal))


@pytest.mark.parametrize("state", State)
def test_another_path_starts_again_from_every_state(state: State) -> None:
    assert TRANSITIONS[state, Signal.PATH_CHANGED] is State.STARTUP


def test_only_a_standing_queue_leads_to_competition_and_only_an_empty_one_out_of_it() -> None:
    into = {(state, signal) for (state, signal), after in TRANSITIONS.items() if after is State.COMPETITIVE}
    assert into - {(State.COMPETITIVE, signal) for signal in Signal} == {
        (State.DELAY, Signal.QUEUE_STANDS),
        (State.PROBE, Signal.PROBE_OVER),
    }
    assert TRANSITIONS[State.COMPETITIVE, Signal.QUEUE_EMPTY] is State.DELAY
    assert TRANSITIONS[State.PROBE, Signal.QUEUE_EMPTY] is State.DELAY
