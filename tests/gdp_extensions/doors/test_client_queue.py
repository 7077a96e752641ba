"""Queue of one client: bounded, oldest first, and the largest subscription gives way."""

from __future__ import annotations

from gdp_extensions.doors.core.client_queue import CONTROL_MAX_BYTES, ClientQueue, Pending


def drained(queue: ClientQueue) -> list[tuple[int, bytes]]:
    found = []
    while (item := queue.pop()) is not None:
        assert isinstance(item, Pending)
        found.append((item.key, item.raw))
    return found


def test_messages_leave_in_the_order_in_which_they_came() -> None:
    queue = ClientQueue()
    for number in range(6):
        queue.put(number % 2, 0, bytes([number]))
    assert drained(queue) == [(number % 2, bytes([number])) for number in range(6)]
    assert (queue.held_bytes, queue.dropped) == (0, 0)


def test_a_control_message_goes_first() -> None:
    queue = ClientQueue()
    queue.put(1, 0, b"data")
    queue.put_control("status")
    assert queue.pop() == "status"


def test_the_oldest_message_of_the_largest_subscription_is_dropped() -> None:
    queue = ClientQueue(data_max_bytes=100)
    queue.put(1, 0, b"small")
    for number in range(4):
        queue.put(2, 0, bytes([number]) * 40)
    assert drained(queue) == [(1, b"small"), (2, b"\2" * 40), (2, b"\3" * 40)]
    assert queue.dropped == 2


def test_a_message_that_is_larger_than_the_bound_replaces_the_others() -> None:
    queue = ClientQueue(data_max_bytes=100)
    queue.put(1, 0, b"small")
    queue.put(2, 0, bytes(500))
    assert drained(queue) == [(2, bytes(500))]
    assert queue.dropped == 1


def test_the_number_of_messages_is_bounded() -> None:
    queue = ClientQueue(data_max_messages=3)
    for number in range(9):
        queue.put(1, 0, bytes([number]))
    assert [raw for _, raw in drained(queue)] == [b"\6", b"\7", b"\10"]


def test_a_subscription_can_have_a_bound_of_its_own() -> None:
    queue = ClientQueue()
    for number in range(5):
        queue.put(1, 0, bytes([number]), depth=1)
        queue.put(2, 0, bytes([number]))
    assert [raw for key, raw in drained(queue) if key == 1] == [b"\4"]
    assert queue.dropped == 4


def test_messages_of_an_ended_subscription_leave_uncounted() -> None:
    queue = ClientQueue()
    queue.put(1, 0, b"one")
    queue.put(2, 0, b"two")
    queue.forget(1)
    queue.forget(3)
    assert drained(queue) == [(2, b"two")]
    assert queue.dropped == 0


def test_control_messages_that_pile_up_are_noticed() -> None:
    queue = ClientQueue()
    queue.put_control(bytes(CONTROL_MAX_BYTES))
    assert not queue.is_overrun
    queue.put_control(b"x")
    assert queue.is_overrun
