"""Fair queue: each owner has its turn, even if another one fills the queue."""

from __future__ import annotations

import pytest

from gdp.message.fair_queue import FairQueue


def test_an_owner_with_one_item_does_not_wait_for_another_with_many() -> None:
    queue = FairQueue[int]()
    for number in range(1_000):
        queue.put(b"greedy", number)
    queue.put(b"modest", -1)
    assert [queue.pop() for _ in range(4)] == [0, -1, 1, 2]
    assert len(queue) == 997


def test_items_of_one_owner_stay_in_order_and_an_empty_queue_says_so() -> None:
    queue = FairQueue[int]()
    for number in range(3):
        queue.put(b"one", number)
    assert [queue.pop() for _ in range(3)] == [0, 1, 2]
    with pytest.raises(KeyError):
        queue.pop()
