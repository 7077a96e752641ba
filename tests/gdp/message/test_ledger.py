"""Ledger of a publisher's sequence numbers: what it remembers of the time of publication is bounded."""

from __future__ import annotations

import pytest

from gdp.message.ledger import Ledger
from gdp.message.renumbering import Renumbering

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


def test_a_message_alone_is_found_by_its_new_number_and_a_bundle_by_none() -> None:
    ledger = Ledger(0)
    ledger.put(number=1, sequence=1, messages=1)
    ledger.put(number=2, sequence=2, messages=3)
    move = Renumbering(1, 2, 4)
    ledger.move(move)
    assert (ledger.number_of(1), ledger.number_of(2)) == (move.new_number(1), None)
    assert ledger.is_bundle(move.new_number(2))
