"""Frames under way: what reports confirm of frames that were sent again."""

from __future__ import annotations

import pytest

from gdp.client.reader_path import ReaderPaths
from gdp.client.sent_frames import SentFrames
from gdp.client.writer_proxy import WriterProxyState
from gdp.congestion.controller import PathController
from gdp.frame.codec import Header, Kind, decode, encode
from gdp.message.acknack import AckNack, AckNackFlag
from tests.gdp.client.pipe import Pipe, publisher_of

READER = bytes(32)


def frame(part: int) -> bytes:
    return encode(Header(Kind.DATA, 0, 8, 1, 100, 7, part, 9, 1, bytes(32), bytes(32))) + bytes(100)


def report(received: int) -> AckNack:
    """Return a report whose newest fragment is the third."""
    return AckNack(AckNackFlag.NONE, 7, 0, (), 1, received=received, newest=7, newest_part=2)


def test_a_lost_frame_among_those_sent_again_does_not_block_the_window() -> None:
    paths = ReaderPaths()
    under_way = SentFrames(paths)
    under_way.sent([frame(part) for part in range(3)], [READER], 0.0)
    under_way.handle_report(READER, report(1), 0.01)  # two are lost
    controller = paths.path(READER, 0.01).controller
    assert controller.rate.inflight == 0
    under_way.sent([frame(0), frame(1)], [READER], 0.02, again=2)
    under_way.handle_report(READER, report(2), 0.03)
    assert controller.rate.inflight > 0  # the other may still come
    under_way.handle_report(READER, report(2), 0.05)
    assert controller.rate.inflight == 0
    under_way.sent([frame(0)], [READER], 0.06, again=1)
    under_way.handle_report(READER, report(2), 0.07)
    assert controller.rate.inflight > 0  # nothing of it has come
    under_way.handle_report(READER, report(3), 0.08)
    assert controller.rate.inflight == 0


def shown(received: int, newest: int) -> AckNack:
    return AckNack(AckNackFlag.NONE, 7, 0, (), 1, received=received, newest=7, newest_part=newest)


def controller_of(paths: ReaderPaths) -> PathController:
    return paths.path(READER, 0.0).controller


def test_a_repair_that_came_shows_that_the_end_of_the_flight_before_is_lost() -> None:
    paths = ReaderPaths()
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(part) for part in range(4)], [READER], 0.0)
    under_way.handle_report(READER, shown(2, 1), 0.01)  # a part of the flight
    assert controller.rate.inflight > 0
    under_way.sent([frame(2), frame(3)], [READER], 0.02, again=2)
    before = controller.model.loss
    under_way.handle_report(READER, shown(3, 2), 0.03)
    under_way.handle_report(READER, shown(4, 3), 0.03)
    assert controller.rate.inflight == 0
    assert controller.model.loss > before


def test_what_was_given_up_and_comes_late_confirms_nothing_that_has_just_left() -> None:
    paths = ReaderPaths()
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(0)], [READER], 0.0)
    under_way.handle_report(READER, shown(1, 0), 0.05)
    under_way.sent([frame(1), frame(2)], [READER], 0.1)
    controller.timed_out(0.5)
    under_way.sent([frame(3), frame(4)], [READER], 0.5)
    under_way.handle_report(READER, shown(3, 2), 0.51)
    assert controller.rate.inflight > 0
    under_way.handle_report(READER, shown(5, 4), 0.6)
    assert controller.rate.inflight == 0
    assert controller.model.rtt_s == pytest.approx(0.1)


def test_a_frame_that_was_sent_again_gives_no_round_trip_since_its_first_time() -> None:
    paths = ReaderPaths()
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(0)], [READER], 0.0)
    under_way.handle_report(READER, shown(1, 0), 0.05)
    under_way.sent([frame(1)], [READER], 0.1)  # lost
    under_way.sent([frame(1)], [READER], 0.4, again=1)
    under_way.handle_report(READER, shown(2, 1), 0.45)
    assert controller.rate.inflight == 0
    assert controller.model.rtt_s == pytest.approx(0.05)


def test_a_repair_to_several_readers_gives_no_round_trip_either() -> None:
    paths, other = ReaderPaths(), bytes([1]) * 32
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(0)], [READER, other], 0.0)
    under_way.handle_report(READER, shown(1, 0), 0.05)
    under_way.sent([frame(1)], [READER, other], 0.1)
    under_way.sent([frame(1)], [READER, other], 0.4, again=1)
    under_way.handle_report(READER, shown(2, 1), 0.45)
    assert controller.model.rtt_s == pytest.approx(0.05)


def test_a_part_of_the_first_flight_measures_the_round_trip() -> None:
    paths = ReaderPaths()
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(part) for part in range(4)], [READER], 0.0)
    under_way.handle_report(READER, shown(1, 0), 0.05)
    assert controller.model.rtt_s == pytest.approx(0.05)
    assert controller.rate.inflight > 0


def test_a_report_of_frames_that_left_for_other_readers_alone_confirms_nothing() -> None:
    paths, other = ReaderPaths(), bytes([1]) * 32
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(0)], [READER, other], 0.0)
    under_way.handle_report(READER, shown(1, 0), 0.05)
    controller.timed_out(0.1)
    under_way.sent([frame(1), frame(2)], [other], 0.1)
    under_way.handle_report(READER, shown(2, 1), 0.15)
    under_way.sent([frame(3)], [READER, other], 0.2)
    under_way.handle_report(READER, shown(3, 2), 0.21)
    assert controller.model.rtt_s is None
    under_way.handle_report(READER, shown(4, 3), 0.3)
    assert controller.model.rtt_s == pytest.approx(0.1)


def test_repairs_to_several_readers_confirm_the_lost_end_of_a_message() -> None:
    paths, other = ReaderPaths(), bytes([1]) * 32
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(0)], [READER, other], 0.0)
    under_way.sent([frame(1), frame(2)], [READER, other], 0.0)
    under_way.handle_report(READER, shown(1, 0), 0.05)
    under_way.sent([frame(1), frame(2)], [READER, other], 0.06, again=2)
    under_way.handle_report(READER, shown(1, 0), 0.07)
    assert controller.rate.inflight > 0
    under_way.handle_report(READER, shown(2, 0), 0.1)
    under_way.handle_report(READER, shown(3, 0), 0.1)
    assert controller.rate.inflight == 0


def test_a_repair_to_several_readers_leaves_the_places_of_later_frames_known() -> None:
    paths, other = ReaderPaths(), bytes([1]) * 32
    under_way, controller = SentFrames(paths), controller_of(paths)
    under_way.sent([frame(0), frame(1)], [READER, other], 0.0)
    for name in (READER, other):
        under_way.handle_report(name, shown(1, 0), 0.05)
    under_way.sent([frame(2), frame(3)], [READER, other], 0.1)
    under_way.sent([frame(1)], [READER, other], 0.1, again=1)
    for name in (READER, other):
        under_way.handle_report(name, shown(2, 2), 0.15)
    under_way.handle_report(READER, shown(3, 3), 0.15)
    assert controller.rate.inflight == 0


def test_a_report_that_comes_before_the_next_poll_confirms_the_frames_that_left_last() -> None:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a")
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    pipe.run(1.0)
    pipe.publisher.publish(bytes(5_000))
    for sent in pipe.publisher.poll_frames(pipe.now_s):
        end.writer_proxy.receive(decode(sent), sent, pipe.now_s, 0.0)
    reports = end.writer_proxy.control_to_send(pipe.now_s + 0.1)
    assert reports
    pipe.now_s += 0.1
    pipe.tell(*reports)
    pipe.publisher.sent_frames.count()
    assert not pipe.publisher.sent_frames.is_unconfirmed
