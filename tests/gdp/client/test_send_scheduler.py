"""Send scheduler: of the publishers with data to send, urgent ones go first, the others in turn."""

from __future__ import annotations

from typing import Any

from gdp.client.governing_paths import GoverningPaths
from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPaths
from gdp.client.reader_proxies import ReaderProxies
from gdp.client.send_options import PRIORITIES, Priority, SendOptions, is_urgent
from gdp.client.send_scheduler import SendScheduler
from gdp.client.sent_frames import SentFrames
from gdp.client.timer_queue import TimerQueue
from gdp.frame.codec import decode
from gdp.names import Name
from tests.gdp.client.pipe import Pipe, publisher_of


def read_by_one() -> Publisher:
    publisher = publisher_of()
    pipe = Pipe(publisher)
    pipe.join(b"a")
    pipe.run(1.0)
    return publisher


class ThinPath(GoverningPaths):
    """Path that permits some bytes of all publishers together."""

    def __init__(self, left: list[int]) -> None:
        self.left = left
        self.share = 1.0
        self.awaited: frozenset[bytes] = frozenset()

    def is_limited(self, now_s: float) -> bool:
        return False

    def awaited_readers(self) -> frozenset[bytes]:
        return self.awaited

    def allowance(self, now_s: float) -> int:
        return self.left[0]

    def next_send_s(self, now_s: float) -> float | None:
        return 5.0

    def note_idle(self) -> None:
        pass


class Names(dict[bytes, Any]):
    """All names."""

    def __contains__(self, name: object) -> bool:
        return True


class Everyone(ReaderProxies):
    """Readers on every node."""

    def __init__(self) -> None:
        self.active = Names()


class Flood(Publisher):
    """A publisher that always has frames."""

    def __init__(
        self, path: list[int], *, weight: int = 1, waiting: int = 1 << 30, priority: Priority = "normal"
    ) -> None:
        self.governing_paths: ThinPath = ThinPath(path)
        self.matched = Everyone()
        self.sent_frames, self.queue = SentFrames(ReaderPaths()), publisher_of().queue
        self.options = SendOptions(weight=weight, priority=priority)
        self.is_urgent, self.is_background = is_urgent(priority), priority == "background"
        self.waiting = waiting
        self.frames_out = 0
        self.has_more = True

    def poll_frames(self, now_s: float, limit_bytes: int = 1 << 30) -> list[bytes]:
        count = min(-(-limit_bytes // 1_500), self.waiting)
        self.governing_paths.left[0] -= count * 1_500
        self.frames_out += count
        self.waiting -= count
        self.has_more = self.waiting > 0
        return [bytes(1_500)] * count


def scheduled(*floods: Flood) -> SendScheduler:
    turns = SendScheduler(TimerQueue())
    for flood in floods:
        turns.add(flood)
    return turns


def test_floods_on_a_thin_path_share_it_frame_by_frame_by_their_weights() -> None:
    path = [0]
    light, heavy = Flood(path), Flood(path, weight=3)
    turns = scheduled(light, heavy)
    for _ in range(4_000):
        path[0] = 1_500  # as a paced path permits
        turns.resume()
        turns.poll_turn(0.0)
        assert abs(heavy.frames_out - 3 * light.frames_out) <= 8
    assert light.frames_out + heavy.frames_out == 4_000


def test_a_small_message_waits_for_two_frames_of_a_flood_at_most() -> None:
    path = [0]
    flood, scan = Flood(path), Flood(path, waiting=1)
    turns = scheduled(flood)
    for at in range(10):
        if at == 5:
            before = flood.frames_out
            turns.add(scan)
        path[0] = 1_500
        turns.resume()
        turns.poll_turn(0.0)
        if scan.frames_out:
            break
    assert scan.frames_out == 1
    assert flood.frames_out - before <= 2


def test_an_urgent_flood_leaves_before_an_ordinary_one() -> None:
    path = [15_000]
    ordinary, urgent = Flood(path), Flood(path, priority="urgent", waiting=4)
    turns = scheduled(ordinary, urgent)
    turns.poll_turn(0.0)
    assert (urgent.frames_out, ordinary.frames_out) == (4, 0)


def test_urgent_frames_leave_before_interactive_ones_whichever_came_first() -> None:
    path = [6_000]
    interactive, urgent = Flood(path, priority="interactive"), Flood(path, priority="urgent", waiting=4)
    scheduled(interactive, urgent).poll_turn(0.0)
    assert (urgent.frames_out, interactive.frames_out) == (4, 0)


def test_four_priorities_share_a_thin_path_by_their_weights_and_background_takes_what_they_leave() -> None:
    path = [0]
    floods = {priority: Flood(path, priority=priority) for priority in reversed(PRIORITIES[2:])}
    turns = scheduled(*floods.values())
    for _ in range(3_000):
        path[0] = 1_500
        turns.resume()
        turns.poll_turn(0.0)
    assert [round(floods[each].frames_out / 100) for each in PRIORITIES[2:]] == [16, 8, 4, 2, 0]
    assert floods["background"].frames_out <= 2  # of a round that began before the others had frames
    for each in PRIORITIES[2:-1]:
        floods[each].waiting = 0
    for _ in range(100):
        path[0] = 1_500
        turns.resume()
        turns.poll_turn(0.0)
    assert floods["background"].frames_out >= 90


def test_weights_share_what_a_priority_has() -> None:
    path = [0]
    low, heavy = Flood(path, priority="normal"), Flood(path, priority="low", weight=4)
    turns = scheduled(low, heavy)
    for _ in range(300):
        path[0] = 1_500
        turns.resume()
        turns.poll_turn(0.0)
    assert abs(heavy.frames_out - 2 * low.frames_out) <= 8


def test_only_two_priorities_have_the_flag_that_switches_know() -> None:
    assert [each for each in PRIORITIES if is_urgent(each)] == ["urgent", "interactive"]


def test_what_the_path_holds_back_is_due_when_the_path_says_so() -> None:
    turns = scheduled(Flood([0]))
    assert turns.poll_turn(1.0) == []
    assert not turns.is_ready
    assert turns.due_s == 5.0
    turns.resume()
    assert turns.is_ready


def test_a_publisher_that_has_no_more_is_not_asked_again_until_it_has() -> None:
    timers, publisher = TimerQueue[Publisher](), read_by_one()
    turns = SendScheduler(timers)
    publisher.published = turns.add
    assert not turns.is_ready
    publisher.publish(b"one")
    assert turns.is_ready
    (frames,) = turns.poll_turn(101.0)
    assert decode(frames[0]).destination == Name(b"t" * 32)
    assert not turns.is_ready
    assert turns.poll_turn(101.0) == []
    assert list(timers.touched) == [publisher]


def test_paths_are_reserved_for_a_publisher_to_several_readers_for_a_quarter_of_a_second_and_then_not_as_long() -> None:
    waits, other = Flood([0]), Flood([1 << 20])
    waits.governing_paths.awaited = frozenset((b"a", b"b"))
    turns = scheduled(waits, other)
    sent = []
    for step in range(20):
        turns.resume()
        before = other.frames_out
        turns.poll_turn(0.05 * step)
        sent.append(other.frames_out > before)
        other.governing_paths.left[0] = 1 << 20
    assert sent == [*[False] * 5, *[True] * 5, *[False] * 5, *[True] * 5]
    waits.governing_paths.left[0] = 1 << 20
    turns.resume()
    turns.poll_turn(1.0)
    assert waits.frames_out > 0
