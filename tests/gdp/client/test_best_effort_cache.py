"""Best-effort cache: what it holds, for how long, and how much it sends again."""

from __future__ import annotations

import pytest

from gdp.client.best_effort_cache import CACHE_BYTES, FIRST_CREDIT_BYTES, BestEffortCache
from gdp.client.send_options import DEFAULT_OPTIONS, SendOptions
from gdp.frame.codec import decode
from gdp.limits import REPAIR_S
from gdp.message.acknack import MissingRange
from tests.gdp.message.sealed import seal

READER = b"r" * 32
MTU = 1_500


def filled(count: int = 1, *, size: int = 100_000, options: SendOptions = DEFAULT_OPTIONS) -> BestEffortCache:
    cache = BestEffortCache(options)
    for number in range(1, count + 1):
        cache.record_sent(seal(number, bytes(size), mtu=MTU), 0.0)
    return cache


def everything(number: int) -> list[MissingRange]:
    return [MissingRange(number, 0, 1 << 31)]


def repaired(cache: BestEffortCache, number: int, now_s: float) -> list[int]:
    """Return the fragments of a message that are sent again when a reader lacks all of it."""
    cache.request(READER, everything(number), now_s)
    return [decode(frame).part for frame in cache.frames_to_send(now_s, 1 << 20)]


def test_a_message_of_two_fragments_is_not_cached() -> None:
    assert len(filled(size=2_000)) == 0
    assert len(filled(size=4_000)) == 1


@pytest.mark.parametrize("deadline_s", [None, 0.05, 2.0])
def test_a_message_is_repaired_until_its_time_is_over_and_not_later(deadline_s: float | None) -> None:
    cache = filled(options=SendOptions(deadline_s=deadline_s))
    until_s = deadline_s or REPAIR_S
    assert repaired(cache, 1, until_s - 0.01)
    assert repaired(cache, 1, until_s + 0.01) == []
    assert (len(cache), cache.held_bytes) == (0, 0)


def test_a_requested_repair_that_is_late_by_its_turn_is_not_sent() -> None:
    cache = filled()
    cache.request(READER, everything(1), REPAIR_S - 0.01)
    assert cache.frames_to_send(REPAIR_S + 0.01, 100) == []


def test_without_repairs_nothing_is_cached() -> None:
    assert len(filled(options=SendOptions(repairs=False))) == 0


def test_a_topic_whose_repairs_are_switched_off_drops_what_is_cached() -> None:
    cache = filled(2)
    cache.set_options(SendOptions(repairs=False))
    assert (len(cache), cache.held_bytes) == (0, 0)
    assert repaired(cache, 1, 0.01) == []


def test_the_cache_keeps_within_its_bytes_and_the_newest_messages() -> None:
    cache = filled(20, size=1 << 20)
    assert cache.held_bytes <= CACHE_BYTES
    assert repaired(cache, 12, 0.1) == []
    assert repaired(cache, 20, 0.1)


def test_a_message_above_the_bound_is_not_cached() -> None:
    cache = filled(size=CACHE_BYTES + 1)
    assert (len(cache), cache.held_bytes) == (0, 0)


def test_repairs_are_at_most_half_of_what_was_sent() -> None:
    cache = filled(4)
    sent = FIRST_CREDIT_BYTES + cache.held_bytes // 2
    again = sum(len(repaired(cache, number, 0.01 * step)) for step in range(1, 40) for number in range(1, 5))
    assert again * MTU < sent + 10 * MTU


def test_the_part_of_a_message_that_was_not_sent_is_not_repaired() -> None:
    cache, frames = BestEffortCache(DEFAULT_OPTIONS), seal(1, bytes(100_000), mtu=MTU)
    cache.record_sent(frames[:10], 0.0)
    assert repaired(cache, 1, 0.01) == list(range(10))
    cache.record_sent(frames[10:], 0.02)
    cache.request(READER, [MissingRange(1, 12, 12)], 0.1)
    assert cache.frames_to_send(0.1, 100) == [frames[12]]


def test_frames_that_no_longer_fit_the_path_are_not_repaired() -> None:
    cache = filled()
    cache.drop_larger(1_400)
    assert (len(cache), cache.held_bytes) == (0, 0)
