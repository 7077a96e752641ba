"""Exclusive control of a topic: who passes, and when the stop is due."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gdp.errors import DropReason, LocalError
from gdp.names import Name
from proxy.bridge.core.exclusive_control import ControlState, ExclusiveControl

ONE, OTHER = Name(b"1" * 32), Name(b"2" * 32)
BOTH = {ONE, OTHER}
SILENCE_S = 0.5


@pytest.fixture
def control() -> ExclusiveControl:
    return ExclusiveControl(SILENCE_S, 7)


def held(control: ExclusiveControl, now_s: float = 10.0) -> ExclusiveControl:
    """Return control that one publisher has taken, and whose first message has passed."""
    control.take(ONE, now_s, since_ns=100, force=False)
    assert control.refusal(ONE, 100, 0.0, now_s) is None
    return control


def test_without_a_holder_nothing_passes_and_nothing_is_due(control: ExclusiveControl) -> None:
    assert control.refusal(ONE, 0, 0.0, 10.0) is DropReason.NOT_IN_CONTROL
    assert (control.state(10.0), control.get_timer(), control.refused) == (ControlState.FREE, None, 1)
    assert not control.poll_stop(BOTH, 10.0)


def test_only_the_holder_passes_and_another_takes_by_force_alone(control: ExclusiveControl) -> None:
    held(control)
    assert control.refusal(OTHER, 500, 0.0, 10.1) is DropReason.NOT_IN_CONTROL
    with pytest.raises(LocalError, match="another publisher holds control"):
        control.take(OTHER, 10.1, since_ns=0, force=False)
    assert control.holder == ONE
    control.take(OTHER, 10.1, since_ns=0, force=True)
    assert control.refusal(ONE, 500, 0.0, 10.1) is DropReason.NOT_IN_CONTROL
    assert control.refusal(OTHER, 500, 0.0, 10.1) is None


@pytest.mark.parametrize(("stamp_ns", "age_s", "passes"), [(100, 0.5, True), (99, 0.0, False), (100, 0.51, False)])
def test_what_was_sent_before_control_or_long_ago_does_not_pass(
    control: ExclusiveControl, stamp_ns: int, age_s: float, passes: bool
) -> None:
    held(control)
    assert control.refusal(ONE, stamp_ns, age_s, 10.2) is (None if passes else DropReason.LATE)


def test_age_does_not_count_without_a_limit_of_silence() -> None:
    control = held(ExclusiveControl(None, 7))
    assert control.refusal(ONE, 100, 60.0, 10.0) is None
    assert control.state(1_000.0) is ControlState.HELD
    assert not control.poll_stop(BOTH, 1_000.0)


def test_the_stop_is_due_once_when_the_holder_is_silent_and_again_after_its_next_message(
    control: ExclusiveControl,
) -> None:
    held(control)
    assert not control.poll_stop(BOTH, 10.4)
    assert control.get_timer() == 10.0 + SILENCE_S
    assert [control.poll_stop(BOTH, at_s) for at_s in (10.5, 10.6, 12.0)] == [True, False, False]
    assert (control.state(12.0), control.holder) == (ControlState.SILENT, ONE)
    assert control.refusal(ONE, 200, 0.0, 13.0) is None
    assert control.state(13.1) is ControlState.HELD
    assert control.poll_stop(BOTH, 13.5)


@pytest.mark.parametrize("silence_s", [SILENCE_S, None])
def test_a_silent_holder_without_a_route_loses_control(silence_s: float | None) -> None:
    control = held(ExclusiveControl(silence_s, 7))
    assert control.poll_stop({OTHER}, 10.6)
    assert (control.holder, control.get_timer()) == (None, None)


def test_a_holder_whose_route_changes_while_it_sends_keeps_control(control: ExclusiveControl) -> None:
    assert not held(control).poll_stop({OTHER}, 10.1)
    assert control.holder == ONE


@pytest.mark.parametrize(
    ("change", "timer_s", "due"),
    [
        (lambda control: control.give(None, 10.2), 0.0, True),
        (lambda control: control.give(OTHER, 10.2), 10.0, False),
        (lambda control: control.take(OTHER, 10.2, since_ns=0, force=True), 10.0, False),
    ],
)
def test_control_that_is_given_to_none_stops_at_once_and_another_has_its_time(
    control: ExclusiveControl, change: Callable[[ExclusiveControl], None], timer_s: float, due: bool
) -> None:
    held(control)
    control.poll_stop(BOTH, 9.5)
    change(control)
    assert control.get_timer() == timer_s
    assert control.poll_stop(BOTH, 10.3) is due
    assert control.poll_stop(BOTH, 10.7) is not due


def test_each_granted_request_begins_a_generation(control: ExclusiveControl) -> None:
    held(control).give(None, 10.2)
    assert control.generation == 9
