"""Renumbering: every number is either an old one or a new one, and order stays."""

from __future__ import annotations

from gdp.message.renumbering import Renumbering

MOVE = Renumbering(first=10, span=5, to=16)


def test_what_is_kept_goes_on_in_order() -> None:
    assert [MOVE.new_number(number) for number in range(10, 15)] == list(range(16, 21))


def test_who_has_everything_goes_on_behind_everything() -> None:
    assert MOVE.new_number(15) == 21


def test_who_lags_behind_what_is_kept_goes_on_at_its_beginning() -> None:
    assert {MOVE.new_number(number) for number in range(10)} == {16}


def test_a_new_number_stays() -> None:
    assert [MOVE.new_number(number) for number in (16, 20, 21, 99)] == [16, 20, 21, 99]
    assert not any(MOVE.is_before(number) for number in (16, 99))
