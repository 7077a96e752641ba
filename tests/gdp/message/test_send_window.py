"""Send window: the messages that a publisher keeps, has in flight, and sends again."""

from __future__ import annotations

import pytest

from gdp.intervals import NEVER_S, READER
from gdp.limits import FLIGHT_MAX_BYTES, FLIGHT_MESSAGES_MAX, NACKS_PER_REPORT, REPAIRS_MAX_BYTES
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.flow_control import PROBES
from gdp.message.renumbering import Renumbering
from gdp.message.send_window import SendWindow

A, B = b"a" * 32, b"b" * 32
PART = 1_000


def message(number: int, parts: int) -> list[bytes]:
    return [number.to_bytes(4, "big") + part.to_bytes(4, "big") + bytes(PART - 8) for part in range(parts)]


def put(window: SendWindow, number: int, frames: list[bytes]) -> list[int]:
    return window.add(number, frames, size(frames))


def window_of(messages: int, parts: int, readers: tuple[bytes, ...] = (A,), keep_last: int = 0) -> SendWindow:
    window = SendWindow(history_depth=keep_last)
    for reader in readers:
        window.add_reader(reader, 1, 0.0)
    for number in range(1, messages + 1):
        put(window, number, message(number, parts))
    return window


def has(number: int, part: int = 0, missing: tuple[MissingRange, ...] = ()) -> AckNack:
    return AckNack(AckNackFlag.NONE, number, part, missing)


def size(frames: list[bytes]) -> int:
    return sum(map(len, frames))


def test_no_more_than_the_flight_is_under_way() -> None:
    window = window_of(50, 100)
    sent = size(window.frames_to_send(0.0))
    assert FLIGHT_MAX_BYTES - PART < sent <= FLIGHT_MAX_BYTES + PART
    assert window.frames_to_send(1.0) == []


def test_what_goes_out_is_every_frame_once_and_in_order() -> None:
    window = window_of(30, 40)
    sent: list[bytes] = []
    now_s = 0.0
    while not window.is_acknowledged():
        frames = window.frames_to_send(now_s)
        sent += frames
        now_s += 0.01
        at, part = divmod(len(sent), 40)
        window.handle_acknack(A, has(at + 1, part), now_s)
    assert sent == [frame for number in range(1, 31) for frame in message(number, 40)]
    assert window.cache.oldest is None
    assert window.cache.held_bytes == 0


def test_a_missing_part_is_sent_again_before_anything_new() -> None:
    window = window_of(20, 100)
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(1, 2, (MissingRange(1, 2, 3), MissingRange(2, 7, 7))), 0.1)
    frames = window.frames_to_send(0.1)
    assert frames[:3] == [message(1, 100)[2], message(1, 100)[3], message(2, 100)[7]]
    assert window.retransmissions == 3


def test_a_part_is_not_repaired_twice_in_a_round_trip() -> None:
    window = window_of(1, 100)
    window.frames_to_send(0.0)
    for at in range(10):
        window.handle_acknack(A, has(1, 2, (MissingRange(1, 2, 2),)), 0.1 + at * 0.0001)
        window.frames_to_send(0.1 + at * 0.0001)
    assert window.retransmissions == 1
    window.handle_acknack(A, has(1, 2, (MissingRange(1, 2, 2),)), 1.0)
    window.frames_to_send(1.0)
    assert window.retransmissions == 2


def test_a_part_that_arrived_while_its_second_repair_waited_is_not_sent_again() -> None:
    window = window_of(1, 100)
    assert len(window.frames_to_send(0.0, limit=30)) == 30
    window.handle_acknack(A, has(1, 9, (MissingRange(1, 9, 29),)), 1.0)
    assert window.frames_to_send(1.0, limit=15) == message(1, 100)[9:24]
    window.handle_acknack(A, has(1, 9, (MissingRange(1, 9, 29),)), 2.0)  # they are late, not lost
    window.handle_acknack(A, has(1, 24, (MissingRange(1, 24, 29),)), 2.1)
    assert window.frames_to_send(2.1, limit=10) == message(1, 100)[24:34]


def test_a_part_that_a_suspended_reader_lacks_is_sent_though_the_others_have_it() -> None:
    window = window_of(2, 20, (A, B))
    window.frames_to_send(0.0)
    window.readers.suspend(B)
    window.handle_acknack(A, has(3, 0), 0.1)
    put(window, 3, message(3, 20))
    window.frames_to_send(0.1)
    window.handle_acknack(B, has(1, 5, (MissingRange(1, 5, 7),)), 0.2)
    assert window.frames_to_send(0.2) == message(1, 20)[5:8]


def test_what_was_never_sent_is_no_repair() -> None:
    window = window_of(20, 100)
    sent = len(window.frames_to_send(0.0, limit=10))
    window.handle_acknack(
        A, has(1, 0, (MissingRange(1, 0, 0xFFFF_FFFF), MissingRange(9, 0, 5), MissingRange(1 << 63, 0, 5))), 0.1
    )
    assert sent == 10
    window.frames_to_send(0.1)
    assert window.retransmissions == 10


def test_all_readers_together_get_one_flight_of_repairs_in_a_round_trip() -> None:
    readers = tuple(bytes([at]) * 32 for at in range(1, 30))
    window = SendWindow()
    for reader in readers:
        window.add_reader(reader, 1, 0.0)
    sent = 0
    for number in range(1, 41):
        put(window, number, message(number, 1_000))
        sent += len(window.frames_to_send(0.0))
        for reader in readers[1:]:
            window.handle_acknack(reader, has(number, 999), 0.0)
    everything = tuple(MissingRange(1 + at % 40, 0, 0xFFFF_FFFF) for at in range(NACKS_PER_REPORT))
    before = window.retransmissions
    flight = REPAIRS_MAX_BYTES
    for reader in readers:
        for at in range(20):
            window.handle_acknack(reader, has(1, 0, everything), 10.0 + at * 0.0001)
            window.frames_to_send(10.0 + at * 0.0001)
    assert 0 < (window.retransmissions - before) * PART <= flight + PART


def test_no_more_parts_are_looked_at_for_one_report_than_a_flight_of_small_frames_has() -> None:
    window = SendWindow()
    window.add_reader(A, 1, 0.0)
    put(window, 1, [bytes(10)] * 20_000)
    assert len(window.frames_to_send(0.0)) == 20_000
    absurd = tuple(MissingRange(1, 0, 0xFFFF_FFFF) for _ in range(NACKS_PER_REPORT))
    for at in range(3):  # the second and third check only fragments that the first has queued
        window.handle_acknack(A, has(1, 0, absurd), 0.1 + at * 1e-6)
    assert len(window.frames_to_send(0.2)) == 8_192


def test_a_reader_that_reports_unsent_messages_takes_nothing_from_another() -> None:
    window = window_of(20, 100, (A, B))
    window.frames_to_send(0.0)
    window.handle_acknack(A, has((1 << 64) - 1, 0xFFFF_FFFF), 0.1)
    assert window.cache.oldest == 1
    assert not window.is_acknowledged()
    assert window.readers.least() - 1 == 0


def test_a_reader_that_reports_unsent_messages_does_not_make_them_unsent() -> None:
    window = window_of(5, 100)
    sent = window.frames_to_send(0.0)
    window.handle_acknack(A, has((1 << 64) - 1), 0.1)
    sent += window.frames_to_send(0.1)
    assert sent == [frame for number in range(1, 6) for frame in message(number, 100)]


def test_what_every_reader_received_under_an_old_number_is_not_sent_again() -> None:
    window = window_of(4, 100, (A, B))
    window.frames_to_send(0.0, 300)
    window.renumber(Renumbering(1, 4, 6), [(n, message(n, 200), 200 * PART) for n in range(6, 10)])
    window.frames_to_send(0.1, 50)
    window.handle_acknack(A, has((1 << 64) - 1), 0.2)
    assert window.sent == (6, 50)
    window.handle_acknack(B, has(8), 0.2)
    assert window.sent == (8, 0)
    assert window.readers.least() - 1 == 7
    window.handle_acknack(B, has((1 << 64) - 1), 0.3)
    assert window.sent == (9, 0)  # it was never sent: no reader has it
    assert window.frames_to_send(0.3) == message(9, 200)


def test_what_is_older_than_every_reader_is_not_sent() -> None:
    window = SendWindow(history_depth=0)
    window.add_reader(A, 3, 0.0)
    window.add_reader(B, 4, 0.0)
    for number in range(1, 5):  # they waited to be sealed until the readers came
        put(window, number, message(number, 100))
    assert window.frames_to_send(0.0, 250) == [*message(3, 100), *message(4, 100)]
    assert window.readers.least() - 1 == 2
    window.handle_acknack(A, has(5), 0.1)
    window.handle_acknack(B, has(5), 0.1)
    assert window.is_acknowledged()


def test_the_slowest_reader_holds_the_window() -> None:
    window = window_of(2, 10, (A, B))
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(3), 0.1)
    assert window.cache.oldest == 1
    window.handle_acknack(B, has(2), 0.1)
    assert window.cache.oldest == 2
    assert window.readers.least() - 1 == 1


def test_a_reader_that_leaves_holds_nothing_any_more() -> None:
    window = window_of(2, 10, (A, B))
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(3), 0.1)
    window.drop_reader(B)
    assert window.is_acknowledged()
    assert window.cache.oldest is None


def test_the_last_messages_are_kept_for_late_joiners() -> None:
    window = window_of(10, 3, keep_last=4)
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(11), 0.1)
    assert window.cache.oldest == 7
    window.drop_reader(A)
    assert window.cache.oldest == 7


def test_a_full_window_says_so_and_lets_the_oldest_go_at_twice_its_budget() -> None:
    window = SendWindow(budget_bytes=10 * PART)
    window.add_reader(A, 1, 0.0)
    for number in range(1, 11):
        assert window.has_space()
        put(window, number, message(number, 1))
    assert not window.has_space()
    evicted = [each for number in range(11, 26) for each in put(window, number, message(number, 1))]
    assert evicted == [1, 2, 3, 4, 5]
    assert window.cache.held_bytes <= 20 * PART
    assert window.cache.oldest == 6


def test_numbers_under_way_stay_within_the_readers_replay_window() -> None:
    window = SendWindow()
    window.add_reader(A, 1, 0.0)
    for number in range(1, FLIGHT_MESSAGES_MAX + 500):
        put(window, number, [b"x" * 10])
    assert len(window.frames_to_send(0.0)) == FLIGHT_MESSAGES_MAX


def test_probes_come_when_readers_are_silent_and_back_off() -> None:
    window = window_of(1, 10)
    assert window.get_timer() == NEVER_S
    window.frames_to_send(5.0)
    times = []
    now_s = 5.0
    for _ in range(10):
        due_s = window.get_timer()
        assert not window.probe_due(due_s - 0.001)
        assert window.probe_due(due_s)
        times.append(due_s - now_s)
        now_s = due_s
    assert times == sorted(times)
    assert times[-1] == pytest.approx(PROBES.most_s)
    window.handle_acknack(A, has(2), now_s)
    assert window.get_timer() == NEVER_S


def test_a_reader_that_does_not_move_for_its_lease_is_slow() -> None:
    window = window_of(1, 10, (A, B))
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(2), 0.1)
    for at in range(1, 6):
        window.handle_acknack(B, has(1), float(at))
    assert window.slow_readers(READER.lease_s - 0.1) == []
    assert window.slow_readers(READER.lease_s + 0.2) == [B]


def test_a_reader_that_moves_too_slowly_is_slow_only_where_others_wait_for_it() -> None:
    for readers, expected in (((A, B), [B]), ((B,), [])):
        window = window_of(1, 200, readers)
        window.frames_to_send(0.0)
        if A in readers:
            window.handle_acknack(A, has(2), 0.1)
        for at in range(1, 10):
            window.handle_acknack(B, has(1, at), float(at))
        assert window.slow_readers(9.0) == expected


@pytest.mark.parametrize("lag_s", [1.0, READER.lease_s])
def test_a_reader_is_slow_when_it_has_not_confirmed_for_so_long_what_another_has(lag_s: float) -> None:
    window = SendWindow(lag_s=lag_s)
    for reader in (A, B):
        window.add_reader(reader, 1, 0.0)
    now_s = 10.0
    for number in range(1, 5):  # both have everything each time, until B reports nothing more
        put(window, number, message(number, 1))
        window.frames_to_send(now_s)
        window.handle_acknack(A, has(number + 1), now_s)
        if number < 3:
            window.handle_acknack(B, has(number + 1), now_s)
        now_s += lag_s / 4
    behind_s = 10.0 + lag_s / 2  # when A confirmed the third
    assert window.slow_readers(behind_s + lag_s - 0.01) == []
    due_s = window.readers.next_slow()
    assert due_s == pytest.approx(behind_s + lag_s, abs=0.01)
    assert window.slow_readers(due_s) == [B]
    window.drop_reader(B)
    assert window.readers.next_slow() == NEVER_S
    assert window.is_acknowledged()


def test_a_reader_that_lagged_behind_a_removed_one_is_not_slow() -> None:
    window = SendWindow(lag_s=1.0)
    for reader in (A, B):
        window.add_reader(reader, 1, 0.0)
    put(window, 1, message(1, 1))
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(2), 0.1)
    window.drop_reader(A)
    assert window.readers.next_slow() == NEVER_S
    assert window.slow_readers(2.0) == []
    assert window.slow_readers(READER.lease_s + 0.2) == [B]


def test_a_reader_that_owed_nothing_for_long_is_no_slow_reader_when_something_new_goes_out() -> None:
    window = window_of(1, 10)
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(2), 0.1)
    put(window, 2, message(2, 10))
    window.frames_to_send(1_000.0)
    assert window.slow_readers(1_000.1) == []
    assert window.slow_readers(1_000.1 + READER.lease_s) == [A]


def test_a_newcomer_begins_at_its_message() -> None:
    window = window_of(3, 10, keep_last=3)
    window.frames_to_send(0.0)
    window.handle_acknack(A, has(4), 0.1)
    window.add_reader(B, 2, 0.2)
    assert not window.is_acknowledged()
    window.handle_acknack(B, has(2, 0, (MissingRange(2, 0, 0xFFFF_FFFF), MissingRange(3, 0, 0xFFFF_FFFF))), 0.3)
    assert window.frames_to_send(0.3) == message(2, 10) + message(3, 10)
    window.handle_acknack(B, has(4), 0.4)
    assert window.is_acknowledged()


def test_a_cancelled_message_sends_nothing_more_and_the_next_one_goes_on() -> None:
    window = window_of(3, 10)
    window.frames_to_send(0.0, 4)
    assert window.cancel(1)
    assert window.cancel(3)
    assert window.frames_to_send(0.1) == message(2, 10)
    window.handle_acknack(A, has(4), 0.2)
    assert window.is_acknowledged()
    assert window.cache.held_bytes == 0


def test_a_cancelled_message_that_was_sent_is_given_up_when_a_reader_lacks_something_of_it() -> None:
    window = window_of(2, 10, (A, B))
    window.frames_to_send(0.0)
    assert not window.cancel(1)
    assert not window.cancel(2)
    window.handle_acknack(A, has(3), 0.1)
    lacks = has(1, 3, (MissingRange(1, 3, 5),))
    assert window.poll_cancelled(lacks) == [1]
    window.handle_acknack(B, lacks, 0.2)
    assert window.frames_to_send(0.2) == []
    assert window.cache.oldest == 2
    window.handle_acknack(B, has(3), 0.3)
    assert window.is_acknowledged()


def test_where_one_reader_governs_the_repairs_of_others_leave_after_what_is_new() -> None:
    window = window_of(2, 10, (A, B))
    window.governing = A
    window.frames_to_send(0.0, 10)
    window.handle_acknack(B, has(1, 3, (MissingRange(1, 3, 3),)), 0.1)
    assert window.late_repairs_to_send(0.1, 10) == []
    assert window.frames_to_send(0.1) == message(2, 10)
    assert window.late_repairs_to_send(0.1, 10) == message(1, 10)[3:4]
