"""Ledger of a publisher's sequence numbers: what it remembers of the time of publication is bounded."""

from __future__ import annotations

import pytest

from gdp.message.ledger import Ledger

PERIOD_S = 0.01


@pytest.mark.parametrize("count", [64, 65, 1_000, 50_000])
def test_a_second_leads_to_no_message_before_it_and_to_one_soon_after_it(count: int) -> None:
    ledger = Ledger(0)
    for number in range(count):
        ledger.next(number * PERIOD_S)
    for number in range(0, count, max(count // 100, 1)):
        found = ledger.first_since(number * PERIOD_S)
        assert number + 1 <= found <= number + 1 + count // 4
    assert ledger.first_since(count * PERIOD_S) == count + 1


def test_the_times_of_at_most_64_messages_are_remembered() -> None:
    ledger = Ledger(0)
    for number in range(50_000):
        ledger.next(number * PERIOD_S)
        assert len(ledger._times) <= 64


def test_messages_without_a_time_are_counted_and_not_remembered() -> None:
    ledger = Ledger(7)
    assert [ledger.next(), ledger.next(1.0), ledger.next()] == [8, 9, 10]
    assert ledger.messages == 3
    assert (ledger.first_since(1.0), ledger.first_since(1.1)) == (9, 11)
