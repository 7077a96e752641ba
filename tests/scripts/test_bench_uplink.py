"""Sans-I/O parts of the uplink bench: the emulated link in virtual time, the traffic, and the figures."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from itertools import groupby
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts" / "bench"))

import uplink
from machine import data_folder
from report import Rounds
from thin_link import score
from thin_link.channel import Channel, ConstantRate, Flow, Loss, TraceRate
from thin_link.conditions import Conditions, load_trace
from thin_link.exchange import Exchange, Tally, Window
from thin_link.line import Used
from thin_link.score import idle_ms, link_figures, merged, stream_figures, whole_share
from thin_link.traffic import Stream, carried_s, make_message, open_message, streams, wire_bytes

from gdp.errors import LocalError

MS = 1_000_000
FRAME = 1_500


def channel(
    *, bits_s: float = 12e6, delay_ms: float = 0, fifo_bytes: int = 1 << 30, loss: Loss | None = None
) -> Channel:
    """Return a channel; 12 Mbit/s sends a full frame in a millisecond."""
    return Channel(
        ConstantRate(bits_s), delay_ns=round(delay_ms * MS), fifo_bytes=fifo_bytes, loss=loss or Loss(0, 1, 1)
    )


def test_a_frame_on_an_idle_link_takes_its_time_on_the_wire_and_the_delay() -> None:
    assert channel(delay_ms=30).offer(5 * MS, FRAME) == 36 * MS


def test_frames_that_arrive_together_leave_one_after_the_other_at_the_rate() -> None:
    link = channel()
    assert [link.offer(0, FRAME) for _ in range(3)] == [MS, 2 * MS, 3 * MS]


def test_a_fifo_holds_exactly_its_bytes_and_drops_the_next_frame() -> None:
    link = channel(fifo_bytes=10 * FRAME)
    found = [link.offer(0, FRAME) for _ in range(12)]
    assert [each is None for each in found] == [False] * 10 + [True] * 2
    assert link.counters.queue_drops == 2


def test_a_fifo_takes_a_frame_again_when_one_has_left() -> None:
    link = channel(fifo_bytes=2 * FRAME)
    assert [link.offer(0, FRAME) for _ in range(3)][-1] is None
    assert link.offer(MS, FRAME) == 3 * MS


def test_every_frame_is_counted_once_by_its_fate() -> None:
    link = channel(fifo_bytes=20 * FRAME, loss=Loss(0.3, 1, 7))
    for at in range(500):
        link.offer(at * MS // 2, FRAME, is_marked=at % 2 == 0)
    link.backlog_bytes(10_000 * MS)
    counters = link.counters
    assert counters.offered == counters.queue_drops + counters.losses + counters.delivered == 500
    assert counters.delivered_bytes == FRAME * counters.delivered
    assert 0 < counters.marked_bytes < counters.delivered_bytes


def test_a_frame_that_still_waits_is_not_counted_as_delivered() -> None:
    link = channel()
    for _ in range(10):
        link.offer(0, FRAME)
    assert link.backlog_bytes(4 * MS) == 6 * FRAME
    assert link.counters.delivered == 4


def test_the_highest_queue_of_each_tenth_of_a_second_is_kept_until_it_is_taken() -> None:
    link = channel()
    for at in (0, 0, 0, 150 * MS):
        link.offer(at, FRAME)
    assert link.take_flow(150 * MS).depth_bytes == [3 * FRAME, FRAME]
    link.offer(160 * MS, FRAME)
    assert link.take_flow(160 * MS).depth_bytes == [FRAME]


@pytest.mark.parametrize(("share", "burst"), [(0.01, 1.0), (0.05, 1.0), (0.02, 8.0)])
def test_loss_has_its_share_and_its_bursts_in_the_long_run(share: float, burst: float) -> None:
    loss = Loss(share, burst, 3)
    fates = [loss.is_lost() for _ in range(300_000)]
    bursts = [sum(1 for _ in run) for is_lost, run in groupby(fates) if is_lost]
    assert sum(fates) / len(fates) == pytest.approx(share, rel=0.1)
    assert sum(bursts) / len(bursts) == pytest.approx(burst / (1 - share) if burst == 1 else burst, rel=0.1)


def test_one_seed_loses_the_same_frames_and_another_one_others() -> None:
    one, again, other = (Loss(0.05, 1, seed) for seed in (1, 1, 2))
    fates = [(one.is_lost(), again.is_lost(), other.is_lost()) for _ in range(1_000)]
    assert all(a == b for a, b, _ in fates)
    assert any(a != c for a, _, c in fates)


@pytest.mark.parametrize(("share", "burst"), [(1.0, 1.0), (-0.1, 1.0), (0.1, 0.5)])
def test_a_loss_out_of_bounds_is_refused(share: float, burst: float) -> None:
    with pytest.raises(ValueError, match="a loss has"):
        Loss(share, burst, 1)


def test_a_recorded_link_sends_at_its_moments_and_repeats() -> None:
    rate = TraceRate([2, 5, 10])
    assert [rate.depart_ns(0, FRAME) // MS for _ in range(5)] == [2, 5, 10, 12, 15]


def test_an_opportunity_without_a_frame_is_lost() -> None:
    rate = TraceRate([2, 5, 10])
    assert rate.depart_ns(6 * MS, FRAME) == 10 * MS


def test_every_system_meets_the_same_link_after_a_rewind() -> None:
    link = Channel(TraceRate([2, 5, 10]), delay_ns=0, fifo_bytes=1 << 30, loss=Loss(0.5, 1, 1))
    before = [link.offer(0, FRAME) for _ in range(20)]
    link.rewind(1_007 * MS)
    after = [link.offer(1_007 * MS, FRAME) for _ in range(20)]
    assert [each and each + 1_007 * MS for each in before] == after
    assert link.rate.capacity_bytes(1_007 * MS, 1_017 * MS) == 2 * FRAME


def test_small_frames_share_an_opportunity_and_large_ones_take_several() -> None:
    rate = TraceRate([2, 5, 10])
    assert [rate.depart_ns(0, 700) // MS for _ in range(3)] == [2, 2, 5]
    assert TraceRate([2, 5, 10]).depart_ns(0, 3_001) == 10 * MS


def test_the_capacity_of_a_recorded_link_counts_its_opportunities() -> None:
    rate = TraceRate([2, 5, 5, 10])
    assert rate.capacity_bytes(0, 10 * MS) == 3 * FRAME
    assert rate.capacity_bytes(0, 30 * MS) == 11 * FRAME
    assert ConstantRate(8e6).capacity_bytes(0, 1_000 * MS) == pytest.approx(1e6)


@pytest.mark.parametrize("moments", [[], [0, 0], [5, 3]])
def test_a_recording_without_length_or_order_is_refused(moments: list[int]) -> None:
    with pytest.raises(ValueError, match="trace"):
        TraceRate(moments)


def test_a_fifo_of_a_bdp_and_of_a_second_follow_from_rate_and_round_trip() -> None:
    bdp, second = (Conditions.of("10", 60, "0", fifo, seed=1) for fifo in ("bdp", "second"))
    assert (bdp.up.fifo_bytes, second.up.fifo_bytes) == (75_000, 1_250_000)
    assert bdp.up.delay_ms == bdp.down.delay_ms == 30


def test_the_shortest_fifo_has_two_frames() -> None:
    assert Conditions.of("1", 10, "0", "bdp", seed=1).up.fifo_bytes == 2 * FRAME


def test_each_direction_of_a_recording_has_its_own_rate(tmp_path: Path) -> None:
    (tmp_path / "radio.up").write_text("10\n20\n", encoding="ascii")
    (tmp_path / "radio.down").write_text("1\n2\n", encoding="ascii")
    found = Conditions.of("radio", 60, "burst", "second", seed=1, traces=tmp_path)
    assert found.up.bits_s == pytest.approx(1.2e6)
    assert found.down.bits_s == pytest.approx(12e6)
    assert (found.up.loss, found.up.burst) == (0.02, 8.0)


def test_a_missing_recording_is_named_with_the_option_for_its_folder(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match=r"no recording .*radio\.up .*--traces"):
        Conditions.of("radio", 60, "0", "bdp", seed=1, traces=tmp_path)


def test_a_rate_that_is_none_is_refused() -> None:
    for rate in ("0", "fast"):
        with pytest.raises(LocalError, match="rate"):
            Conditions.of(rate, 60, "0", "bdp", seed=1)


def test_a_recording_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "radio.up").write_text("fast\n", encoding="ascii")
    with pytest.raises(LocalError, match="no recording of a link"):
        load_trace(tmp_path / "radio.up")


def test_the_recorded_links_are_read_whole() -> None:
    for path in data_folder("uplinks", ["*.up", "*.down"]).glob("*-LTE-*"):
        assert len(load_trace(path)) > 10_000


def test_a_message_is_whole_only_at_its_length_and_with_both_numbers() -> None:
    message = make_message(7, 99, bytes(100))
    assert len(message) == 100
    assert open_message(message, 100) == (7, 99)
    assert open_message(message[:-1], 100) is None
    assert open_message(message[:-1] + b"\x01", 100) is None


def test_the_link_is_never_asked_for_more_than_its_rate() -> None:
    for camera in ("raw", "jpeg"):
        mix = streams(camera)
        for bits_s in (1e6, 5e6, 20e6, 100e6):
            found = carried_s(mix, bits_s, 0.05)
            used = sum(found[each.name] * wire_bytes(each.size) for each in mix if each.name in found)
            assert used <= bits_s / 8 * 0.95 + 1e-6


def test_bulk_streams_share_what_is_left_max_min_fair() -> None:
    mix = streams("jpeg")
    by_name = {each.name: each for each in mix}
    thin, wide = carried_s(mix, 10e6, 0.0), carried_s(mix, 100e6, 0.0)
    lidar, camera = (thin[name] * wire_bytes(by_name[name].size) for name in ("lidar", "camera"))
    assert lidar == pytest.approx(camera)
    assert (wide["lidar"], wide["camera"]) == pytest.approx((10, 30))


def reports(camera_ages_s: list[float]) -> tuple[tuple[Stream, ...], dict[str, Tally]]:
    """Return the JPEG traffic, and a window of a second in which cmd_vel and these images arrived."""
    mix = streams("jpeg")
    found = {each.name: Tally(10, 10) for each in mix}
    found["camera"] = Tally(30, 30, camera_ages_s)
    return mix, found


def test_images_are_compared_with_what_the_link_could_carry() -> None:
    link = Conditions.of("10", 60, "0", "second", seed=1)
    mix, said = reports([0.1] * 6)
    camera = next(each for each in mix if each.name == "camera")
    found = stream_figures(camera, said["camera"], link, mix, {"camera": 12.0, "lidar": 5.0}, 1.0)
    assert found[score.OF_LINK] == 0.5
    assert found[score.FRACTION] == 0.2
    assert found[score.OVER_IDLE] == pytest.approx(100 - idle_ms(camera, link, mix))
    assert whole_share(mix, said, {"camera": 12.0, "lidar": 0.0}, 1.0) == pytest.approx(0.5)


def test_a_stream_of_which_nothing_arrived_has_a_fraction_and_no_age() -> None:
    mix, said = reports([])
    found = stream_figures(mix[0], said["cmd_vel"], Conditions.of("1", 10, "0", "bdp", seed=1), mix, {}, 1.0)
    assert found[score.FRACTION] == 0
    assert score.AGE_P99 not in found


def test_the_idle_age_of_an_answer_includes_its_request() -> None:
    mix, link = streams("jpeg"), Conditions.of("10", 60, "0", "bdp", seed=1)
    by_name = {each.name: each for each in mix}
    assert idle_ms(by_name["service request"], link, mix) == pytest.approx(30.16)
    assert idle_ms(by_name["service answer"], link, mix) == pytest.approx(61.04)


def test_an_answer_is_due_for_each_request_that_was() -> None:
    mix = streams("jpeg")
    silent = {each.name: {"due": 0, "sent": 0, "ages_s": [], "whole": 0, "broken": 0, "doubled": 0} for each in mix}
    robot = {**silent, "service request": {**silent["service request"], "due": 9, "sent": 8}}
    found = merged(mix, robot, silent)
    assert (found["service request"].due, found["service answer"].due) == (9, 9)


def test_the_share_of_a_system_is_that_of_the_link_without_the_tcp_flow() -> None:
    flow = Flow(
        offered=4,
        queue_drops=1,
        delivered_bytes=900,
        marked_bytes=300,
        capacity_bytes=1e3,
        depth_bytes=[7_500, 15_000, 7_500],
    )
    used = Used(flow, flow, 0.2)
    found = link_figures(Conditions.of("10", 60, "0", "bdp", seed=1), used, used)
    assert found[score.SHARE_BOTH] == pytest.approx(0.6)
    assert found[score.TCP_BOTH] == 0.3
    assert found[score.QUEUE_P50] == pytest.approx(6.0)
    assert found[score.DROPS] == 25


class Loopback:
    """Carrier whose messages arrive at another exchange at once."""

    def __init__(self) -> None:
        self.far: Exchange | None = None

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        def send(message: bytes) -> None:
            assert self.far is not None
            self.far.take(stream, message, time.monotonic_ns())

        return send

    def subscribe(self, stream: Stream) -> None:
        pass

    def is_matched(self) -> bool:
        return True


def test_every_message_of_a_window_is_due_sent_and_arrives_once_where_nothing_holds_it_up() -> None:
    mix = (
        Stream("request", 100, 0.02, "up", reliable=True),
        Stream("answer", 50, 0.0, "down", reliable=True, answers="request"),
    )
    robot, cloud, ways = Exchange(mix, "up"), Exchange(mix, "down"), (Loopback(), Loopback())
    ways[0].far, ways[1].far = cloud, robot
    start_ns = time.monotonic_ns()
    window = Window(start_ns, start_ns, start_ns + 200 * MS)
    for end, way in ((robot, ways[0]), (cloud, ways[1])):
        end.join(way)
    for end in (cloud, robot):
        end.start(window)
    sent, answered = robot.tallies["request"], robot.tallies["answer"]
    deadline_s = time.monotonic() + 10
    (publishing,) = (each for each in threading.enumerate() if each.name == "publish request")
    publishing.join(10)
    while len(answered.ages_s) < sent.sent:
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
    assert sent.due == 10
    assert len(cloud.tallies["request"].ages_s) == sent.sent == len(answered.ages_s)
    assert cloud.tallies["request"].doubled == 0
    assert robot.refusals == cloud.refusals == []


def test_a_message_outside_the_window_or_not_whole_is_not_an_arrival() -> None:
    (stream,) = mix = (Stream("tf", 100, 0.01, "up", reliable=True),)
    cloud = Exchange(mix, "down")
    cloud.join(Loopback())
    cloud.start(Window(0, 100, 200))
    for due_ns in (50, 150, 150, 250):
        cloud.take(stream, make_message(1, due_ns, bytes(100)), 300)
    cloud.take(stream, b"short", 300)
    tally = cloud.tallies["tf"]
    assert (tally.ages_s, tally.doubled, tally.broken, tally.whole) == ([1.5e-7], 1, 1, 0)
    cloud.take(stream, make_message(2, 50, bytes(100)), 150)
    assert (tally.ages_s, tally.whole) == ([1.5e-7], 1)  # it arrived in the window, and was due before


def test_the_grid_of_the_command_line_is_every_combination_of_what_was_chosen() -> None:
    words = ["--rates", "1", "5", "--loss", "0", "burst", "--rtt", "10", "--fifo", "bdp"]
    links = uplink.links_of(uplink.arguments().parse_args(words))
    assert len(links) == len({link.name for link in links}) == 4
    assert links[0].name == "1 Mbit/s, 10 ms, 0 % loss, FIFO of a BDP"


def test_the_camera_is_compressed_on_a_thin_link() -> None:
    thin, wide = (Conditions.of(rate, 60, "0", "bdp", seed=1) for rate in ("20", "100"))
    assert [uplink.camera_of(link) for link in (thin, wide)] == ["jpeg", "raw"]


def test_ours_is_compared_with_the_better_transport_of_zenoh() -> None:
    over = Rounds()
    for name, value in (("zenoh-tls-drop", 5.0), ("zenoh-quic-drop", 3.0), ("gdp", 1.0)):
        over.add(name, "case", "column", value)
    assert uplink.better_zenoh(over, "case", "column", at_most=True) == "zenoh-quic-drop"
    assert uplink.better_zenoh(over, "case", "column", at_most=False) == "zenoh-tls-drop"


def test_every_link_has_targets_for_urgency_freshness_and_fairness() -> None:
    links = [Conditions.of("10", 60, "0", "second", seed=1)]
    found = [target.what for target in uplink.targets_of(Rounds(), links)]
    for what in ("cmd_vel", "tf", "camera", score.SHARE_BOTH, score.TCP_BOTH):
        assert any(what in each for each in found)
