"""Frames under way: what reports confirm of frames that were sent again."""

from __future__ import annotations

from gdp.client.reader_path import ReaderPaths
from gdp.client.sent_frames import SentFrames
from gdp.frame.codec import Header, encode
from gdp.frame.kinds import Kind
from gdp.message.acknack import AckNack, AckNackFlag

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
    assert controller.inflight == 0
    under_way.sent([frame(0), frame(1)], [READER], 0.02, again=2)
    under_way.handle_report(READER, report(2), 0.03)
    assert controller.inflight > 0  # the other may still come
    under_way.handle_report(READER, report(2), 0.05)
    assert controller.inflight == 0
    under_way.sent([frame(0)], [READER], 0.06, again=1)
    under_way.handle_report(READER, report(2), 0.07)
    assert controller.inflight > 0  # nothing of it has come
    under_way.handle_report(READER, report(3), 0.08)
    assert controller.inflight == 0
