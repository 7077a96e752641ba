"""Repairs of large best-effort messages: most arrive in time, in order, and small ones are never delayed."""

from __future__ import annotations

from functools import partial
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.client.send_options import SendOptions
from gdp.client.writer_proxy import WriterProxyState
from gdp.frame.codec import Header, Kind, decode
from gdp.limits import REPAIR_S, REPORT_DELAY_S, REPORT_GAP_S
from gdp.message.late_repairs import HOLD_S
from tests.draws import draws
from tests.gdp.client.pipe import End, Pipe, publisher_of

IMAGE_BYTES = 828_000  # 600 fragments
PERIOD_S = 1 / 30
ONE_WAY_S = 0.03
SCAN_BYTES = 12_000  # 9 fragments
REPAIRS = SendOptions(fec=False)  # parity would leave nothing to repair
NEVER = SendOptions(repairs=False, fec=False)


def joined(*, options: SendOptions = REPAIRS, seed: int = 1, one_way_s: float = ONE_WAY_S) -> tuple[Pipe, End]:
    pipe = Pipe(publisher_of(reliable=False, options=options), seed=seed)
    pipe.delay_s = one_way_s
    end = pipe.join(b"a")
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    return pipe, end


def body(number: int, size: int) -> bytes:
    return number.to_bytes(4, "big") + bytes(size - 4)


def stream(pipe: Pipe, count: int, size: int = IMAGE_BYTES, period_s: float = PERIOD_S) -> None:
    for _ in range(count):
        pipe.publish([body(pipe.publisher.messages, size)])
        pipe.run(period_s)


def got(end: End) -> list[int]:
    return [int.from_bytes(message[:4], "big") for message in end.messages]


def headers(pipe: Pipe, kind: Kind) -> list[Header]:
    return [header for header in map(decode, pipe.seen) if header.kind == kind]


def requests(pipe: Pipe) -> int:
    """Return how many reports named missing fragments: they are longer than those that name none."""
    lengths = [header.length for header in headers(pipe, Kind.ACKNACK)]
    return sum(length > min(lengths) for length in lengths)


def lose(pipe: Pipe, end: End, *losses: tuple[int, int]) -> None:
    """Let these (message number, fragment) be lost once each, on their way to the reader."""
    left, receive = set(losses), end.writer_proxy.receive

    def filtered(header: Header, frame: bytes, now_s: float, waited_s: float = 0.0) -> None:
        if header.kind == Kind.DATA and (header.number, header.part) in left:
            left.discard((header.number, header.part))
        else:
            receive(header, frame, now_s, waited_s)

    end.writer_proxy.receive = filtered  # type: ignore[method-assign]


@pytest.mark.parametrize("loss", [0.01, 0.05])
def test_images_of_600_fragments_arrive_over_a_lossy_link(loss: float) -> None:
    pipe, end = joined(seed=round(loss * 100))
    end.loss = loss
    stream(pipe, 60)
    pipe.run(1.0)
    assert len(end.delivered) >= 0.95 * 60
    assert got(end) == sorted(set(got(end)))
    assert pipe.publisher.protection.repairs < 2 * 60 * 600 * loss


def test_without_repairs_almost_no_image_arrives_and_none_is_sent_again() -> None:
    pipe, end = joined(options=NEVER)
    end.loss = 0.01
    stream(pipe, 20)
    pipe.run(1.0)
    assert len(end.delivered) <= 2
    assert pipe.publisher.protection.repairs == 0


@pytest.mark.parametrize("size", [100, 2_500], ids=["one fragment", "two fragments"])
def test_small_messages_never_wait_and_are_never_requested(size: int) -> None:
    pipe, end = joined()
    end.loss = 0.2
    latest_s = 0.0
    for at in range(100):
        before, published_s = len(end.delivered), pipe.now_s
        pipe.publish([body(at, size)])
        if pipe.run(0.05, lambda before=before: len(end.delivered) > before):  # type: ignore[misc]
            latest_s = max(latest_s, pipe.now_s - published_s)
            pipe.run(0.05 - (pipe.now_s - published_s))
    assert 50 < len(end.delivered) < 90
    assert latest_s < ONE_WAY_S + 1e-6
    assert pipe.publisher.protection.repairs == len(pipe.publisher.protection.late) == 0
    assert requests(pipe) == 0


def test_a_link_without_loss_causes_no_request() -> None:
    pipe, end = joined()
    stream(pipe, 10)
    assert pipe.run(1.0, lambda: len(end.delivered) == 10)
    assert pipe.publisher.protection.repairs == 0
    assert requests(pipe) == 0


def test_a_later_message_waits_for_the_repair_of_an_earlier_one() -> None:
    pipe, end = joined()
    lose(pipe, end, (1, 3))
    pipe.publish([body(0, SCAN_BYTES)])
    pipe.run(0.02)
    pipe.publish([body(1, SCAN_BYTES)])
    pipe.run(ONE_WAY_S + 0.001)
    assert not end.delivered
    assert pipe.run(3 * ONE_WAY_S, lambda: len(end.delivered) == 2)
    assert got(end) == [0, 1]


def test_a_later_message_waits_no_longer_than_the_hold_time() -> None:
    pipe, end = joined()
    lose(pipe, end, (1, 3))
    pipe.publish([body(0, SCAN_BYTES)])
    pipe.run(ONE_WAY_S + 0.001)
    end.mute = True  # its request is lost
    pipe.publish([body(1, SCAN_BYTES)])
    pipe.run(ONE_WAY_S + HOLD_S - 0.005)
    assert got(end) == []
    pipe.run(0.01)
    assert got(end) == [1]
    assert end.writer_proxy.losses.total == 1


def test_a_small_message_behind_a_large_one_keeps_the_order() -> None:
    pipe, end = joined()
    lose(pipe, end, (1, 0))
    pipe.publish([body(0, SCAN_BYTES), body(1, 100)])
    assert pipe.run(0.5, lambda: len(end.delivered) == 2)
    assert got(end) == [0, 1]


def test_a_writer_that_never_repairs_is_not_awaited_for_long() -> None:
    pipe, end = joined(options=NEVER)
    for number in (1, 2, 3):
        lose(pipe, end, (2 * number - 1, 3))
        pipe.publish([body(number, SCAN_BYTES), body(number, SCAN_BYTES)])
        pipe.run(1.0)
    lose(pipe, end, (7, 3))
    pipe.publish([body(7, SCAN_BYTES), body(8, SCAN_BYTES)])
    begun_s = pipe.now_s
    assert pipe.run(1.0, lambda: len(end.delivered) == 4)
    assert pipe.now_s - begun_s < ONE_WAY_S + 1e-6


def test_after_a_writer_repairs_again_it_is_awaited_again() -> None:
    pipe, end = joined()
    for number in range(3):
        end.mute = True
        lose(pipe, end, (2 * number + 1, 3))
        pipe.publish([body(2 * number, SCAN_BYTES), body(2 * number + 1, SCAN_BYTES)])
        pipe.run(1.0)
    assert got(end) == [1, 3, 5]
    end.mute = False
    lose(pipe, end, (7, 3), (8, 3))
    stream(pipe, 2, SCAN_BYTES, 1.0)
    assert got(end) == [1, 3, 5, 6, 7]


def test_a_lost_tail_is_repaired_though_no_message_follows() -> None:
    pipe, end = joined()
    lose(pipe, end, (1, 7), (1, 8))
    pipe.publish([body(0, SCAN_BYTES)])
    # what is newer than all that came is missing after 1.5 round trips
    assert pipe.run(4 * ONE_WAY_S + REPORT_DELAY_S, lambda: len(end.delivered) == 1)


def test_a_lost_request_is_repeated_while_the_repair_can_be_in_time() -> None:
    pipe, end = joined()
    lose(pipe, end, (1, 3))
    pipe.publish([body(0, SCAN_BYTES)])
    end.mute = True
    pipe.run(ONE_WAY_S + 0.01)
    end.mute = False
    assert pipe.run(REPAIR_S, lambda: len(end.delivered) == 1)


def test_more_gaps_than_a_report_names_are_repaired_in_one_round_trip_and_a_few_reports() -> None:
    pipe, end = joined()
    lose(pipe, end, *((1, part) for part in range(1, 600, 4)))
    pipe.publish([body(0, IMAGE_BYTES)])
    assert pipe.run(3 * ONE_WAY_S + 0.03, lambda: len(end.delivered) == 1)
    assert pipe.publisher.protection.repairs == 150


def test_each_gap_of_a_message_that_is_coming_is_requested_at_once_though_others_were_just_before() -> None:
    pipe, end = joined()
    pipe.batch_bytes, pipe.pause_s = 9_000, 0.01  # six fragments
    lose(pipe, end, (1, 3), (1, 8), (1, 14))
    pipe.publish([body(0, IMAGE_BYTES)])
    pipe.run(ONE_WAY_S - 0.001)
    for count in (1, 2, 3):
        pipe.run(REPORT_GAP_S + 0.002)
        assert requests(pipe) == count
        pipe.run(0.01 - REPORT_GAP_S - 0.002)


def test_no_fragment_is_sent_twice_in_a_round_trip_however_many_readers_lack_it() -> None:
    pipe, first = joined()
    second = pipe.join(b"b")
    assert pipe.run(1.0, lambda: second.writer_proxy.state is WriterProxyState.LIVE)
    for end in (first, second):
        lose(pipe, end, (1, 3), (1, 5))
    pipe.publish([body(0, SCAN_BYTES)])
    assert pipe.run(0.3, lambda: len(first.delivered) == len(second.delivered) == 1)
    assert pipe.publisher.protection.repairs == 2


def test_a_dead_reader_costs_nothing() -> None:
    pipe, live = joined()
    dead = pipe.join(b"b")
    assert pipe.run(1.0, lambda: dead.writer_proxy.state is WriterProxyState.LIVE)
    dead.deaf = dead.mute = True
    for at in range(10):
        before, published_s = len(live.delivered), pipe.now_s
        pipe.publish([body(at, SCAN_BYTES)])
        assert pipe.run(0.1, partial(has_more, live, before))
        assert pipe.now_s - published_s < ONE_WAY_S + 1e-6
    pipe.run(2.0)
    assert pipe.publisher.protection.repairs == len(pipe.publisher.protection.late) == 0


def has_more(end: End, than: int) -> bool:
    return len(end.delivered) > than


def test_replayed_frames_start_no_request_and_no_wait() -> None:
    pipe, end = joined()
    lose(pipe, end, *((number, 3) for number in range(1, 6)))
    stream(pipe, 5, SCAN_BYTES)
    pipe.run(2.0)
    assert len(end.delivered) == 5
    old = [frame for frame in pipe.seen if decode(frame).kind == Kind.DATA]
    before = requests(pipe)
    for frame in old:
        end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)
    pipe.run(0.5)
    assert requests(pipe) == before > 0
    assert pipe.publisher.protection.repairs == 5
    assert end.budget.held_bytes == 0


def test_messages_that_are_too_late_hold_no_memory() -> None:
    pipe, end = joined(options=NEVER)
    end.loss = 0.02
    for _ in range(60):
        stream(pipe, 1, 200_000)
        assert end.budget.held_bytes < (REPAIR_S / PERIOD_S + 2) * 2 * 230_000  # early fragments are held twice
    assert len(end.delivered) < 20


def test_a_message_that_takes_a_second_to_send_is_repaired_meanwhile() -> None:
    pipe, end = joined()
    pipe.batch_bytes, pipe.pause_s = 9_000, 0.01
    lose(pipe, end, (1, 3), (1, 300), (1, 590))
    pipe.publish([body(0, IMAGE_BYTES)])
    assert not pipe.run(1.0, lambda: len(end.delivered) == 1)
    assert pipe.run(0.2, lambda: len(end.delivered) == 1)
    assert pipe.publisher.protection.repairs == 3


def test_repairs_leave_before_new_frames() -> None:
    pipe, end = joined()
    pipe.batch_bytes, pipe.pause_s = 9_000, 0.01
    lose(pipe, end, (1, 3))
    pipe.publish([body(0, IMAGE_BYTES)])
    pipe.run(0.2)
    parts = [header.part for header in headers(pipe, Kind.DATA)]
    again = parts.index(3, 4)
    assert again == parts[again - 1] + 1 < 100


@given(
    seed=st.integers(0, 1 << 30),
    loss=st.sampled_from([0.0, 0.01, 0.05, 0.2, 0.4]),
    jitter_s=st.sampled_from([0.0, 0.004, 0.04]),
    doubled=st.sampled_from([0.0, 0.2]),
    one_way_s=st.sampled_from([0.0005, 0.03, 0.15]),
    deadline_s=st.sampled_from([None, 0.05, 2.0]),
)
@draws(20, long=60)
def test_what_arrives_is_whole_in_order_and_once_and_the_rest_is_counted(
    seed: int, loss: float, jitter_s: float, doubled: float, one_way_s: float, deadline_s: float | None
) -> None:
    pipe, end = joined(options=SendOptions(deadline_s=deadline_s, fec=False), seed=seed, one_way_s=one_way_s)
    random, published = Random(seed), dict[int, bytes]()
    end.loss, pipe.jitter_s, pipe.doubled = loss, jitter_s, doubled
    for at in range(40):
        published[at] = body(at, 4) + random.randbytes(random.choice([10, 1_000, 4_000, 20_000, 60_000]))
        pipe.publish([published[at]])
        pipe.run(random.choice([0.0, 0.005, 0.03, 0.1]))
    end.loss = 0.0
    pipe.run(3.0)
    assert got(end) == sorted(set(got(end)))
    assert all(message == published[number] for number, message in zip(got(end), end.messages, strict=True))
    assert len(end.delivered) + end.writer_proxy.losses.total == 40
    assert end.budget.held_bytes == 0
