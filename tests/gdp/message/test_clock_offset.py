"""The offset of a clock lies within its stated bound, whatever the path and the clocks do."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import FrameError
from gdp.message.clock_offset import DRIFT_MAX, ClockEstimate, ClockOffset, ClockStamps
from tests.draws import draws

_ROUNDING_S = 3e-6  # stamps have microseconds
_delays = st.one_of(st.floats(0, 0.002), st.floats(0, 2.0))
_exchanges = st.lists(
    st.tuples(
        st.floats(0.01, 300),  # until it
        _delays,  # there
        st.floats(0, 0.05),  # held
        _delays,  # back
        st.booleans(),  # it is lost
        st.one_of(st.just(0.0), st.floats(-100, 100)),  # step of the far wall clock before it
        st.one_of(st.just(0.0), st.floats(-100, 100)),  # of ours
    ),
    max_size=40,
)


class Clocks:
    """A true time, our monotonic clock, which shows it, and a far one that drifts; both have wall clocks that step."""

    def __init__(self, ahead_s: float, drift: float) -> None:
        self.now_s = 1_000.0
        self.ahead_s, self.drift = ahead_s, drift
        self.far_wall_s, self.our_wall_s = 1.8e9, 1.8e9
        self.clock = ClockOffset()

    def far_s(self, at_s: float) -> float:
        """Return what the far monotonic clock shows."""
        return at_s + self.ahead_s + self.drift * (at_s - 1_000.0)

    def exchange(self, there_s: float, held_s: float, back_s: float) -> ClockStamps:
        """Return the stamps of a reply that comes now."""
        sent_s = self.now_s
        received_s = sent_s + there_s
        left_s = received_s + held_s
        self.now_s = left_s + back_s
        stamps = (self.far_s(received_s), self.far_s(left_s), self.far_wall_s)
        return ClockStamps(*(round(1e6 * each) for each in stamps))

    def add(self, there_s: float, held_s: float, back_s: float) -> None:
        """Make an exchange."""
        sent_s = self.now_s
        stamps = self.exchange(there_s, held_s, back_s)
        self.clock.add(sent_s, stamps, self.now_s, self.now_s)

    @property
    def estimate(self) -> ClockEstimate:
        """Return the present estimate, which exists."""
        estimate = self.clock.estimate(self.now_s, self.now_s + self.our_wall_s)
        assert estimate is not None
        return estimate

    @property
    def error_s(self) -> float:
        """Return how wrong the estimate is."""
        true_s = self.far_s(self.now_s) + self.far_wall_s - (self.now_s + self.our_wall_s)
        return abs(self.estimate.offset_s - true_s)


@draws(300)
@given(ahead_s=st.floats(-1e4, 1e4), drift=st.floats(-DRIFT_MAX, DRIFT_MAX), exchanges=_exchanges)
def test_the_error_never_exceeds_its_bound(
    ahead_s: float, drift: float, exchanges: list[tuple[float, float, float, float, bool, float, float]]
) -> None:
    clocks, is_known, is_current = Clocks(ahead_s, drift), False, False
    for pause_s, there_s, held_s, back_s, is_lost, far_step_s, our_step_s in exchanges:
        clocks.now_s += pause_s
        if is_known and is_current:
            assert clocks.error_s <= clocks.estimate.bound_s + _ROUNDING_S
        clocks.far_wall_s += far_step_s
        clocks.our_wall_s += our_step_s
        is_current &= not far_step_s  # no exchange has shown it yet
        if is_lost:
            clocks.exchange(there_s, held_s, back_s)
            continue
        clocks.add(there_s, held_s, back_s)
        is_known = is_current = True
        assert clocks.error_s <= clocks.estimate.bound_s + _ROUNDING_S


@draws(100)
@given(
    drift=st.floats(-DRIFT_MAX, DRIFT_MAX),
    delays=st.lists(st.tuples(st.floats(0, 2.0), st.floats(0, 2.0)), min_size=2, max_size=20),
    order=st.randoms(use_true_random=False),
)
def test_replies_that_overtake_each_other_keep_the_bound(
    drift: float, delays: list[tuple[float, float]], order: object
) -> None:
    clocks, arrivals = Clocks(0.5, drift), []
    for there_s, back_s in delays:
        sent_s = clocks.now_s
        arrivals.append((sent_s, clocks.exchange(there_s, 0.0, back_s), clocks.now_s))
        clocks.now_s = sent_s + 0.1
    for sent_s, stamps, came_s in sorted(arrivals, key=lambda each: each[2]):
        clocks.now_s = came_s
        clocks.clock.add(sent_s, stamps, came_s, came_s)
        assert clocks.error_s <= clocks.estimate.bound_s + _ROUNDING_S


def test_of_many_exchanges_the_least_delayed_decide() -> None:
    clocks = Clocks(3.0, 0.0)
    for there_s, back_s in ((0.2, 0.001), (0.3, 0.001), (0.0012, 0.4), (0.3, 0.3)):
        clocks.add(there_s, 0.001, back_s)
        clocks.now_s += 1
    assert clocks.error_s < 0.001
    assert clocks.estimate.bound_s < 0.002


def test_a_drift_is_measured_and_carries_the_estimate_on() -> None:
    clocks = Clocks(0.0, 60e-6)
    for _ in range(40):
        clocks.add(0.0005, 0.0001, 0.0005)
        clocks.now_s += 8
    assert clocks.clock.drift == pytest.approx(60e-6, abs=5e-6)
    clocks.now_s += 600
    assert clocks.error_s < 0.004  # 36 ms without


def test_a_node_that_started_again_has_another_clock() -> None:
    clocks = Clocks(5_000.0, 0.0)
    clocks.add(0.001, 0.0, 0.001)
    clocks.ahead_s = 0.0
    clocks.far_wall_s += 5_000.0
    clocks.add(0.001, 0.0, 0.001)
    assert clocks.error_s < 0.001


def test_stamps_that_no_clock_shows_change_nothing() -> None:
    clocks = Clocks(1.0, 0.0)
    clocks.add(0.001, 0.0, 0.001)
    before = clocks.estimate
    clocks.clock.add(clocks.now_s, ClockStamps(0, 10**12, 0), clocks.now_s, clocks.now_s)
    assert clocks.estimate == before


def test_nothing_is_known_before_the_first_exchange() -> None:
    assert ClockOffset().estimate(1.0, 2.0) is None


@draws(100)
@given(st.binary(max_size=40))
def test_any_bytes_are_stamps_or_are_refused(wire: bytes) -> None:
    try:
        assert ClockStamps.from_wire(wire).to_wire() == wire
    except FrameError:
        assert len(wire) != 24
