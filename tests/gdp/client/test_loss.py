"""Loss accounting: every published message is delivered, or counted exactly as lost at its reader with its reason."""

from __future__ import annotations

from functools import partial
from unittest.mock import patch

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gdp.client.writer_proxy import WriterProxyState
from gdp.errors import DropReason
from gdp.frame.codec import decode
from gdp.intervals import FORGET_S, READER
from gdp.limits import WINDOW_BYTES
from gdp.message.loss import LossReason, LostRange
from tests.gdp.client.pipe import End, Pipe, publisher_of


def live(pipe: Pipe, *names: bytes) -> list[End]:
    ends = [pipe.join(name) for name in names]
    assert pipe.run(2.0, lambda: all(end.writer_proxy.state is WriterProxyState.LIVE for end in ends))
    return ends


def silence(end: End, *, is_silent: bool) -> None:
    end.deaf = end.mute = is_silent


def stream(pipe: Pipe, seconds: float, every_s: float = 0.1, size: int = 100) -> None:
    """Publish a message from time to time, for this long."""
    for _ in range(round(seconds / every_s)):
        pipe.publish([pipe.publisher.messages.to_bytes(4, "big") + bytes(size)])
        pipe.run(every_s)


def got(end: End) -> list[int]:
    """Return which messages came, as ``stream`` counted them."""
    return [int.from_bytes(message[:4], "big") for message in end.messages]


def sequences(end: End) -> list[int]:
    return [each.sequence for each in end.delivered]


def assert_complete(pipe: Pipe, end: End) -> None:
    """Check that nothing is doubled, in order, and each message is delivered or in a range of lost ones."""
    pipe.run(5.0)
    numbers = sequences(end)
    lost = [each for span in end.writer_proxy.losses.ranges for each in range(span.first, span.last + 1)]
    assert numbers == sorted(set(numbers))
    assert sorted(numbers + lost) == list(range(numbers[0], pipe.publisher.messages + 1))
    assert end.writer_proxy.losses.total == len(lost)


@pytest.mark.parametrize("away_s", [3.0, 10.0, 30.0])
def test_a_reader_that_was_away_within_the_grace_time_loses_nothing(away_s: float) -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 2.0)
    silence(end, is_silent=True)
    stream(pipe, away_s)
    silence(end, is_silent=False)
    stream(pipe, 2.0)
    assert pipe.run(5.0, pipe.publisher.is_acknowledged)
    assert_complete(pipe, end)
    assert (end.writer_proxy.losses.total, pipe.publisher.losses.total) == (0, 0)
    assert got(end) == list(range(pipe.publisher.messages))
    assert pipe.publisher.acknowledgements.acknowledged == pipe.publisher.messages


def test_a_reader_that_was_away_for_longer_learns_exactly_what_it_lost_and_why() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 2.0)
    silence(end, is_silent=True)
    stream(pipe, READER.lease_s + FORGET_S + 5.0)
    published = pipe.publisher.messages
    silence(end, is_silent=False)
    pipe.run(5.0)
    stream(pipe, 2.0)
    assert_complete(pipe, end)
    first, last = end.writer_proxy.losses.ranges[0].first, end.writer_proxy.losses.ranges[-1].last
    assert (first, last) == (21, published)
    assert {each.reason for each in end.writer_proxy.losses.ranges} == {LossReason.GIVEN_UP, LossReason.NO_READER}
    assert pipe.publisher.losses.counts.keys() == {LossReason.GIVEN_UP, LossReason.NO_READER}
    assert pipe.publisher.messages - pipe.publisher.acknowledgements.acknowledged == end.writer_proxy.losses.total


def test_a_suspended_reader_delays_no_other_and_gets_what_it_lacks_when_it_returns() -> None:
    pipe = Pipe(publisher_of())
    stays, moves = live(pipe, b"a", b"b")
    silence(moves, is_silent=True)
    pipe.run(READER.lease_s + 1.0)
    for _ in range(60):
        pipe.publish([bytes(100_000)])
        assert pipe.publisher.has_space()
    assert pipe.run(3.0, lambda: len(stays.delivered) == 60)
    silence(moves, is_silent=False)
    assert pipe.run(10.0, lambda: len(moves.delivered) == 60)
    assert_complete(pipe, moves)
    assert moves.writer_proxy.losses.total == 0


def has_more_than(end: End, count: int) -> bool:
    return len(end.delivered) > count


def test_others_do_not_wait_for_a_reader_that_catches_up() -> None:
    pipe = Pipe(publisher_of())
    stays, moves = live(pipe, b"a", b"b")
    silence(moves, is_silent=True)
    stream(pipe, 10.0, size=50_000)
    silence(moves, is_silent=False)
    moves.loss = 0.3
    for _ in range(100):
        before = len(stays.delivered)
        pipe.publish([bytes(1_000)])
        assert pipe.run(0.05, partial(has_more_than, stays, before))
    moves.loss = 0.0
    assert pipe.run(30.0, pipe.publisher.is_acknowledged)
    assert_complete(pipe, moves)
    assert moves.writer_proxy.losses.total == 0


def test_what_a_full_window_pushes_out_of_a_suspended_reader_is_lost_and_named() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    silence(end, is_silent=True)
    pipe.run(READER.lease_s + 1.0)
    for _ in range(50):
        pipe.publish([bytes(1 << 20)])
        assert pipe.publisher.has_space()
    gone = pipe.publisher.drops[DropReason.MEMORY_FULL]
    assert WINDOW_BYTES // (1 << 20) - 4 < 50 - gone < WINDOW_BYTES // (1 << 20)  # frames have headers, too
    silence(end, is_silent=False)
    assert pipe.run(20.0, pipe.publisher.is_acknowledged)
    assert_complete(pipe, end)
    assert list(end.writer_proxy.losses.ranges) == [LostRange(11, 10 + gone, LossReason.WINDOW_OVERFLOW)]
    assert pipe.publisher.messages - pipe.publisher.acknowledgements.acknowledged == gone


def test_a_reader_that_was_killed_is_given_up_after_the_grace_time_and_counted() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    silence(end, is_silent=True)
    stream(pipe, 2.0)
    assert not pipe.run(FORGET_S, pipe.publisher.is_acknowledged)
    assert pipe.publisher.losses.total == 0
    pipe.run(READER.lease_s + 1.0)
    assert list(pipe.publisher.losses.ranges) == [LostRange(11, 30, LossReason.GIVEN_UP)]
    assert pipe.publisher.acknowledgements.acknowledged == 10


def test_a_reader_that_starts_again_counts_what_came_between_its_lives() -> None:
    pipe = Pipe(publisher_of())
    (first,) = live(pipe, b"a")
    stream(pipe, 1.0)
    pipe.run(2.0)
    silence(first, is_silent=True)
    stream(pipe, 3.0)
    second = pipe.join(b"a", incarnation=8)
    pipe.run(2.0)
    stream(pipe, 1.0)
    assert list(second.writer_proxy.losses.ranges) == [LostRange(11, 40, LossReason.READER_RESTARTED)]
    assert sequences(second) == list(range(41, 51))


def test_a_reader_that_starts_again_after_it_was_given_up_counts_what_came_between_its_lives() -> None:
    pipe = Pipe(publisher_of())
    (first,) = live(pipe, b"a")
    stream(pipe, 1.0)
    pipe.run(2.0)
    silence(first, is_silent=True)
    stream(pipe, 1.0)
    pipe.run(FORGET_S + READER.lease_s + 2.0)
    stream(pipe, 1.0)
    second = pipe.join(b"a", incarnation=8)
    pipe.run(2.0)
    stream(pipe, 1.0)
    assert list(second.writer_proxy.losses.ranges) == [LostRange(11, 30, LossReason.READER_RESTARTED)]
    assert sequences(second) == list(range(31, 41))


def test_a_reader_that_said_goodbye_has_lost_nothing_when_it_comes_again() -> None:
    pipe = Pipe(publisher_of())
    (first,) = live(pipe, b"a")
    stream(pipe, 1.0)
    (note,) = first.writer_proxy.close()
    pipe.publisher.receive_acknack(decode(note), note, pipe.now_s)
    del pipe.ends[first.reader.name]
    stream(pipe, 1.0)
    second = pipe.join(b"a", incarnation=8)
    pipe.run(1.0)
    stream(pipe, 1.0)
    assert second.writer_proxy.losses.total == 0
    assert len(second.delivered) == 10


def test_the_first_contact_with_a_publisher_that_has_published_for_long_is_no_loss() -> None:
    pipe = Pipe(publisher_of())
    stream(pipe, 5.0)
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    pipe.run(2.0)
    assert end.writer_proxy.losses.total == 0
    assert sequences(end) == list(range(51, 61))
    assert pipe.publisher.losses.counts == {LossReason.NO_READER: 50}


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("burst", [1, 40], ids=["alone", "bundles"])
def test_best_effort_and_reliable_gaps_are_counted_in_messages(burst: int, *, reliable: bool) -> None:
    pipe = Pipe(publisher_of(reliable=reliable), seed=3)
    (end,) = live(pipe, b"a")
    end.loss = 0.2
    for _ in range(100):
        for _ in range(burst):
            pipe.publisher.publish(bytes(50))
        pipe.run(0.01)
    end.loss = 0.0
    assert_complete(pipe, end)
    assert len(end.delivered) + end.writer_proxy.losses.total == 100 * burst
    assert (end.writer_proxy.losses.total == 0) == reliable
    assert end.writer_proxy.losses.counts.keys() <= {LossReason.GAP}


def test_the_last_messages_of_a_best_effort_topic_are_counted_though_none_follows() -> None:
    pipe = Pipe(publisher_of(reliable=False))
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    end.deaf = True
    pipe.publish([b"gone"] * 5)
    end.deaf = False
    pipe.run(3.0)
    assert list(end.writer_proxy.losses.ranges) == [LostRange(11, 15, LossReason.GAP)]


def test_what_a_publisher_passes_over_is_lost_for_its_reason() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    pipe.publisher.skip(LossReason.TOO_LARGE)
    stream(pipe, 1.0)
    pipe.publisher.skip(LossReason.WINDOW_OVERFLOW)
    pipe.run(3.0)
    wanted = [LostRange(11, 11, LossReason.TOO_LARGE), LostRange(22, 22, LossReason.WINDOW_OVERFLOW)]
    assert list(end.writer_proxy.losses.ranges) == wanted
    assert pipe.publisher.messages - pipe.publisher.acknowledgements.acknowledged == 2


def test_a_suspended_reader_is_counted_once_however_often_it_falls_silent() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    for _ in range(3):
        silence(end, is_silent=True)
        stream(pipe, READER.lease_s + FORGET_S + 3.0, every_s=1.0)
        silence(end, is_silent=False)
        pipe.run(3.0)
        stream(pipe, 5.0, every_s=1.0)
    assert_complete(pipe, end)
    assert pipe.publisher.messages - pipe.publisher.acknowledgements.acknowledged == end.writer_proxy.losses.total > 100


OUTAGES = st.lists(
    st.tuples(
        st.sampled_from(["none", "deaf", "mute", "silent", "lossy"]),
        st.sampled_from([0.3, 2.0, 8.0, 75.0]),
        st.integers(1, 8),  # messages at once
        st.sampled_from([20, 3_000]),
    ),
    min_size=1,
    max_size=5,
)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(OUTAGES, st.booleans(), st.integers(0, 1_000))
@example([("deaf", 8.0, 1, 20)], True, 0)
def test_through_any_outages_published_is_delivered_or_lost(
    outages: list[tuple[str, float, int, int]], reliable: bool, seed: int
) -> None:
    pipe = Pipe(publisher_of(reliable=reliable), seed=seed)
    one, other = live(pipe, b"a", b"b")
    pipe.publish([b"first"])
    pipe.run(1.0)
    for kind, for_s, burst, size in outages:
        one.deaf, one.mute = kind in {"deaf", "silent"}, kind in {"mute", "silent"}
        one.loss = 0.3 if kind == "lossy" else 0.0
        for _ in range(10):
            for _ in range(burst):
                pipe.publisher.publish(bytes(size))
            pipe.run(for_s / 10)
    one.deaf = one.mute = False
    one.loss = 0.0
    pipe.run(20.0)
    for end in (one, other):
        assert_complete(pipe, end)
    assert other.writer_proxy.losses.total == 0


def best_effort_without_a_whole_message() -> tuple[Pipe, End]:
    """Return a best-effort stream of 150 messages in 5 s, whose reader gets the last frame of each, and no other."""
    pipe = Pipe(publisher_of(reliable=False))
    (end,) = live(pipe, b"a")
    end.mtu = 1_400
    stream(pipe, 5.0, 1 / 30, size=4_000)
    return pipe, end


def test_a_reader_that_gets_no_message_whole_learns_while_they_flow_that_they_are_lost() -> None:
    pipe, end = best_effort_without_a_whole_message()
    assert pipe.publisher.messages == 150
    assert end.writer_proxy.losses.total > 60
    assert end.writer_proxy.losses.counts.keys() == {LossReason.GAP}


def test_the_publisher_learns_what_a_best_effort_reader_lost() -> None:
    pipe, end = best_effort_without_a_whole_message()
    confirmed = pipe.publisher.acknowledgements
    assert pipe.run(3.0, confirmed.is_reported)
    assert (confirmed.sent, confirmed.reader_lost, end.writer_proxy.losses.total) == (150, 150, 150)


def test_what_waits_on_a_best_effort_topic_has_not_been_sent() -> None:
    pipe = Pipe(publisher_of(reliable=False))
    live(pipe, b"a")
    for _ in range(3):
        pipe.publisher.publish(bytes(4_000), pipe.now_s)
    confirmed = pipe.publisher.acknowledgements
    before = confirmed.sent, confirmed.acknowledged, confirmed.is_reported()
    pipe.run(0.1)
    assert (before, pipe.publisher.acknowledgements.sent) == ((0, 0, False), 3)


@pytest.mark.parametrize("reliable", [True, False])
def test_a_reader_counts_what_is_lost_from_when_its_publisher_knows_it(*, reliable: bool) -> None:
    pipe = Pipe(publisher_of(reliable=reliable))
    end = pipe.join(b"a")
    end.deaf = True
    assert pipe.run(1.0, lambda: pipe.publisher.readers == 1)
    stream(pipe, 2.0)  # no Heartbeat that says where to begin arrives
    end.deaf = False
    stream(pipe, 2.0)
    pipe.run(5.0)
    assert len(got(end)) + end.writer_proxy.losses.total == pipe.publisher.messages == 40
    assert end.writer_proxy.losses.total in ((0,) if reliable else (20, 21))


def test_a_reader_that_is_killed_again_before_it_began_counts_what_it_lacks_since_it_last_did() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    pipe.run(1.0)
    silence(end, is_silent=True)
    stream(pipe, 1.0)
    second = pipe.join(b"a", incarnation=8)
    second.deaf = True
    pipe.run(0.5)
    stream(pipe, 1.0)
    third = pipe.join(b"a", incarnation=9)
    stream(pipe, 1.0)
    pipe.run(1.0)
    assert got(end) == list(range(10))
    assert third.writer_proxy.losses.counts == {LossReason.READER_RESTARTED: got(third)[0] - 10}


def test_a_reader_that_is_killed_while_too_many_begin_counts_what_it_lacks_since_it_last_did() -> None:
    pipe = Pipe(publisher_of())
    (end,) = live(pipe, b"a")
    stream(pipe, 1.0)
    pipe.run(1.0)
    silence(end, is_silent=True)
    stream(pipe, 1.0, size=4_000)  # too large to wait for a bundle
    with patch("gdp.client.heartbeat_schedule.STARTS_MAX", 0):
        pipe.join(b"a", incarnation=8)
        pipe.run(0.5)
        third = pipe.join(b"a", incarnation=9)
        pipe.run(0.5)
    stream(pipe, 1.0)
    pipe.run(1.0)
    assert third.writer_proxy.losses.counts == {LossReason.READER_RESTARTED: got(third)[0] - 10}
