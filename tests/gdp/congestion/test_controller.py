"""Congestion controller on a simulated bottleneck: start-up, queue, loss, acknowledgements, changes and competition."""

from __future__ import annotations

from functools import partial

import pytest

from gdp.congestion.controller import PathController
from gdp.congestion.delivery_rate import DeliveryRate
from gdp.congestion.path_model import PathModel, WindowedExtreme
from gdp.congestion.states import State
from tests.gdp.congestion.simulated_path import MTU, CubicSender, Flow, SimulatedPath
from tests.lanes import nightly

RTT_S = 0.06
SECOND = 1.0


def path(
    mbit_s: float, *, rtt_s: float = RTT_S, fifo_s: float = RTT_S, loss: float = 0.0, burst: float = 1.0
) -> SimulatedPath:
    """Return a path with a FIFO of so many seconds, two frames at least."""
    bits_s = mbit_s * 1e6
    fifo_bytes = max(round(bits_s * fifo_s / 8), 2 * MTU)
    return SimulatedPath(bits_s=bits_s, rtt_s=rtt_s, fifo_bytes=fifo_bytes, loss=loss, burst=burst)


def own(*, start_s: float = 0.0, offered_bytes_s: float = float("inf"), ack_every_s: float = 0.0) -> Flow:
    """Return a flow under the controller."""
    return Flow(PathController(MTU), start_s=start_s, offered_bytes_s=offered_bytes_s, ack_every_s=ack_every_s)


def test_a_gigabit_path_is_full_after_ten_round_trips() -> None:
    link, flow = path(1_000), own()
    link.add(flow)
    link.run(12 * RTT_S)
    assert flow.share(10 * RTT_S, 11 * RTT_S, link.bits_s) >= 0.95


@pytest.mark.parametrize(
    ("mbit_s", "rtt_s"), [(1, 0.2), (5, 0.01), (5, 0.2), *nightly((10, 0.06), (20, 0.01), (20, 0.2))]
)
@pytest.mark.parametrize("deep", [False, True])
def test_a_path_is_used_with_a_short_queue_whatever_its_fifo(mbit_s: float, rtt_s: float, *, deep: bool) -> None:
    link, flow = path(mbit_s, rtt_s=rtt_s, fifo_s=SECOND if deep else rtt_s), own()
    link.add(flow)
    link.run(15)
    frame_s = MTU * 8 / link.bits_s
    assert flow.share(5, 15, link.bits_s) >= 0.95
    assert link.queue_quantile(5, 0.5) <= max(0.015, 4 * frame_s)


def test_a_fifo_of_two_frames_is_enough_for_a_window_of_two_frames() -> None:
    link, flow = path(1, rtt_s=0.01, fifo_s=0.0), own()
    link.add(flow)
    link.run(10)
    assert flow.share(2, 10, link.bits_s) >= 0.9


@pytest.mark.parametrize(("mbit_s", "loss", "burst"), [(20, 0.01, 1.0), (10, 0.05, 1.0), (10, 0.02, 8.0)])
def test_loss_that_is_no_congestion_does_not_reduce_the_rate(mbit_s: float, loss: float, burst: float) -> None:
    link, flow = path(mbit_s, loss=loss, burst=burst), own()
    link.add(flow)
    link.run(15)
    assert flow.share(3, 15, link.bits_s) >= 0.9 * (1 - loss)


def test_aggregated_acknowledgements_neither_stall_a_flow_nor_fill_the_queue() -> None:
    link, flow = path(10, fifo_s=SECOND), own(ack_every_s=0.02)
    link.add(flow)
    link.run(15)
    assert flow.share(3, 15, link.bits_s) >= 0.85
    assert link.queue_quantile(3, 0.99) <= 0.02


def test_a_flow_that_offers_little_gets_all_of_it_and_keeps_the_queue_empty() -> None:
    link, flow = path(10, fifo_s=SECOND), own(offered_bytes_s=312_500)
    link.add(flow)
    link.run(15)
    assert flow.share(3, 15, link.bits_s) == pytest.approx(0.25, abs=0.01)
    assert link.queue_quantile(3, 0.99) <= 0.005


def test_the_capacity_is_known_once_more_waited_than_the_path_carries() -> None:
    link, flow = path(10, fifo_s=SECOND), own(offered_bytes_s=312_500)
    link.add(flow)
    assert isinstance(flow.sender, PathController)
    link.run(10)
    assert flow.sender.model.capacity_bytes_s is None
    link.at(10, lambda: setattr(flow, "offered_bytes_s", float("inf")))
    link.run(20)
    assert flow.sender.model.capacity_bytes_s == pytest.approx(1.25e6, rel=0.1)


def test_a_pause_does_not_inflate_the_window() -> None:
    link, flow = path(10, fifo_s=SECOND), own()
    link.add(flow)
    link.at(5, lambda: setattr(flow, "offered_bytes_s", 2.5e5))
    link.at(10, lambda: setattr(flow, "offered_bytes_s", float("inf")))
    link.run(15)
    assert link.queue_quantile(10, 0.99) <= 0.03


def test_a_path_that_becomes_slower_is_drained_within_two_seconds() -> None:
    link, flow = path(20, fifo_s=SECOND), own()
    link.add(flow)
    link.at(5, lambda: link.set_rate(5e6))
    link.run(12)
    assert link.queue_quantile(7, 0.99) <= 0.02
    assert flow.share(7, 12, 5e6) >= 0.9


@pytest.mark.parametrize("collapsed_bits_s", [3e5, *nightly(1e6, 5e6)])
def test_a_path_that_collapses_behind_a_short_fifo_is_drained_and_used(collapsed_bits_s: float) -> None:
    link, flow = SimulatedPath(bits_s=200e6, rtt_s=0.01, fifo_bytes=64_000), own()
    link.add(flow)
    link.at(2, lambda: link.set_rate(collapsed_bits_s))
    link.run(30)
    assert link.queue_quantile(20, 0.99) <= max(0.1, 8 * MTU * 8 / collapsed_bits_s)
    assert flow.share(20, 30, collapsed_bits_s) >= 0.85


def test_without_a_round_trip_a_confirmation_makes_the_window_no_larger() -> None:
    controller = PathController(MTU)
    controller.timed_out(1.0)
    before = controller.window
    for number in range(100):
        controller.acknowledged([controller.sent(MTU, 1.0 + number)], 1.1 + number, held_s=None)
    assert (controller.window, controller.rate.inflight) == (before, 0)


def test_a_path_that_becomes_faster_is_used_within_two_seconds() -> None:
    link, flow = path(5, fifo_s=SECOND), own()
    link.add(flow)
    link.at(5, lambda: link.set_rate(20e6))
    link.run(12)
    assert flow.share(7, 12, 20e6) >= 0.95


def test_a_longer_path_that_is_named_starts_again_and_is_used() -> None:
    link, flow = path(20, fifo_s=SECOND), own()
    link.add(flow)

    def move() -> None:
        link.rtt_s = 0.2
        assert isinstance(flow.sender, PathController)
        flow.sender.path_changed(link.now_s)

    link.at(5, move)
    link.run(15)
    assert flow.share(8, 15, 20e6) >= 0.9


def test_a_longer_path_that_is_not_named_is_found_out_by_a_probe() -> None:
    link, flow = path(10, fifo_s=SECOND), own()
    link.add(flow)
    link.at(5, lambda: setattr(link, "rtt_s", 0.2))
    link.run(45)
    assert flow.share(35, 45, link.bits_s) >= 0.9
    assert link.queue_quantile(35, 0.5) <= 0.015


def test_two_flows_share_a_path_fairly() -> None:
    link, one, other = path(10, fifo_s=SECOND), own(), own(start_s=5)
    link.add(one)
    link.add(other)
    link.run(30)
    assert one.share(15, 30, link.bits_s) == pytest.approx(0.5, abs=0.1)
    assert other.share(15, 30, link.bits_s) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("fifo_s", [RTT_S, SECOND])
def test_next_to_a_cubic_flow_each_has_35_to_65_percent(fifo_s: float) -> None:
    link, flow, cubic = path(10, fifo_s=fifo_s), own(), Flow(CubicSender(), start_s=5)
    link.add(flow)
    link.add(cubic)
    link.run(75)
    assert 0.35 <= flow.share(15, 75, link.bits_s) <= 0.65
    assert 0.35 <= cubic.share(15, 75, link.bits_s) <= 0.65


_FAST_PATHS = [(fifo_s, is_first) for is_first in (False, True) for fifo_s in (RTT_S / 2, RTT_S, 2 * RTT_S)]


@pytest.mark.nightly
@pytest.mark.parametrize(("fifo_s", "is_first"), _FAST_PATHS)
def test_next_to_a_cubic_flow_on_a_fast_path_each_has_35_to_65_percent(fifo_s: float, *, is_first: bool) -> None:
    link, flow = path(100, fifo_s=fifo_s), own(start_s=0 if is_first else 5)
    cubic = Flow(CubicSender(), start_s=5 if is_first else 0)
    link.add(flow)
    link.add(cubic)
    link.run(35)
    assert 0.35 <= flow.share(15, 35, link.bits_s) <= 0.65
    assert 0.35 <= cubic.share(15, 35, link.bits_s) <= 0.65


@pytest.mark.parametrize(("fifo_s", "least"), [(RTT_S, 0.4), (SECOND, 0.25)])
def test_half_of_a_path_that_was_measured_alone_is_kept_next_to_a_slow_start(fifo_s: float, least: float) -> None:
    link, flow, cubic = path(10, fifo_s=fifo_s), own(), Flow(CubicSender(), start_s=5)
    link.add(flow)
    link.add(cubic)
    link.run(25)
    assert flow.share(8, 18, link.bits_s) >= least
    assert cubic.share(8, 18, link.bits_s) >= 0.35


@pytest.mark.parametrize("fifo_s", [RTT_S, SECOND])
def test_a_later_rate_that_is_lower_is_no_other_flow(fifo_s: float) -> None:
    link, flow = path(20, fifo_s=fifo_s), own()
    link.add(flow)
    rates_s = (5e6, 12e6, 3e6, 20e6, 2e6, 8e6)
    for at, bits_s in enumerate(rates_s):
        link.at(5 + 3 * at, partial(link.set_rate, bits_s))
    link.run(30)
    assert link.queue_quantile(5, 0.5) <= 0.015
    assert link.queue_quantile(5, 0.9) <= 0.2  # what was under way at each change has to leave


@pytest.mark.parametrize("fifo_s", [RTT_S, *nightly(SECOND)])
def test_the_queue_is_short_again_within_ten_seconds_after_a_cubic_flow_has_ended(fifo_s: float) -> None:
    link, flow = path(10, fifo_s=fifo_s), own()
    link.add(flow)
    link.add(Flow(CubicSender(), start_s=5, end_s=30))
    link.run(50)
    assert link.queue_quantile(40, 0.99) <= 0.015
    assert flow.share(40, 50, link.bits_s) >= 0.95


def test_frames_leave_at_the_pace_and_not_in_a_burst() -> None:
    controller = PathController(MTU)
    controller.acknowledged([controller.sent(MTU, 0.0)], 0.06)
    controller.sent(MTU, 0.06)
    assert controller.next_send_s(MTU) == pytest.approx(0.06 + MTU / controller.pace.bytes_s)
    assert controller.pace.bytes_s == pytest.approx(2.89 * controller.window / 0.06)


def test_the_window_is_never_under_two_frames_and_always_lets_one_frame_out() -> None:
    controller = PathController(MTU)
    for number in range(200):
        flight = controller.sent(MTU, number * 0.01)
        if number % 2:
            controller.lost([flight], number * 0.01 + 0.005)
        else:
            controller.acknowledged([flight], number * 0.01 + 0.009)
    assert controller.window >= 2 * MTU
    assert controller.rate.inflight == 0
    assert controller.next_send_s(MTU) is not None


def test_a_larger_mtu_keeps_two_of_its_frames() -> None:
    controller = PathController(MTU)
    controller.window = 2.0 * MTU
    controller.set_mtu(9_000)
    assert controller.window == 18_000


def test_a_flight_that_is_confirmed_again_or_was_given_up_changes_nothing() -> None:
    controller = PathController(MTU)
    given_up = controller.sent(MTU, 0.0)
    controller.timed_out(0.0)
    flight = controller.sent(MTU, 0.0)
    controller.acknowledged([flight], 0.05)
    before = (controller.window, controller.rate.inflight, controller.model.base_rtt_s)
    controller.acknowledged([flight, given_up], 9.0)
    controller.lost([flight, given_up], 9.0)
    assert (controller.window, controller.rate.inflight, controller.model.base_rtt_s) == before


def test_another_path_forgets_its_measurements_and_keeps_what_is_under_way() -> None:
    controller = PathController(MTU)
    flights = [controller.sent(MTU, 0.0) for _ in range(5)]
    controller.acknowledged(flights[:2], 0.05)
    controller.path_changed(0.06)
    assert controller.state is State.STARTUP
    assert controller.rate.inflight == 3 * MTU
    assert controller.model.bytes_s == 0


def test_on_a_path_shorter_than_the_waits_of_programs_four_late_reports_are_a_queue_and_three_are_none() -> None:
    model = PathModel()
    queues_s = []
    for number, rtt_s in enumerate([0.0005, 0.012, 0.012, 0.012, 0.0005, 0.012, 0.012, 0.012, 0.012]):
        model.add_rtt(rtt_s, number * 0.02)
        queues_s.append(model.queue_s)
    assert not any(queues_s[:-1])
    assert queues_s[-1] > 0.009


def test_on_a_longer_path_the_first_late_report_is_a_queue() -> None:
    model = PathModel()
    model.add_rtt(0.01, 0.0)
    model.add_rtt(0.03, 0.03)
    assert model.queue_s > 0


@pytest.mark.parametrize("held_s", [0.0, 0.02])
def test_the_delivery_rate_is_that_of_arrivals_however_long_reports_are_held_back(held_s: float) -> None:
    controller = PathController(MTU)
    for number in range(3):
        controller.acknowledged([controller.sent(8 * MTU, 0.1 * number)], 0.1 * number + 0.001 + held_s, held_s=held_s)
    assert controller.model.bytes_s == pytest.approx(8 * MTU / 0.001)


def test_a_burst_of_acknowledgements_is_no_high_delivery_rate() -> None:
    rate = DeliveryRate()
    flights = [rate.sent(1_000, at * 0.01, at * 1_000) for at in range(11)]
    for flight in flights[:1]:
        rate.acknowledged(flight, 1_000, 0.1, 0.0)
    sample = rate.acknowledged(flights[-1], 10_000, 0.2, 0.0)
    assert sample is not None
    assert sample <= 110_000


def test_a_windowed_extreme_forgets_what_is_older_than_its_window() -> None:
    lowest, highest = WindowedExtreme(is_lowest=True), WindowedExtreme(is_lowest=False)
    known = [
        (lowest.add(at, value, at - 1), highest.add(at, value, at - 1)) for at, value in enumerate((5.0, 1.0, 7.0, 3.0))
    ]
    assert known == [(5.0, 5.0), (1.0, 5.0), (1.0, 7.0), (3.0, 7.0)]
    lowest.clear()
    assert lowest.add(9.0, 9.0, 0.0) == 9.0
