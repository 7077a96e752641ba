"""Placement of replicas on offers, regions and providers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fog.hardware import Hardware
from fog.supervisor.core.record import Outcome
from fog.supervisor.placement import held_until, place, wary_until
from gdp.errors import LocalError
from tests.fog.supervisor.machines import NOW_S, OFFERS, SPOT, offer, record, serving


def region_of(*arguments: object, **more: object) -> str | None:
    choice = place(*arguments, **more)  # type: ignore[arg-type]
    return None if choice is None else choice.offer.region


def test_replicas_go_to_different_regions() -> None:
    assert region_of(SPOT, OFFERS, [serving("m1", "east")], NOW_S) != "east"


def test_a_requested_region_is_taken_though_another_is_cheaper() -> None:
    offers = [offer("east", usd=0.01), offer("west", usd=1.0)]
    assert region_of(replace(SPOT, region="west"), offers, [], NOW_S) == "west"


def test_a_region_that_took_a_machine_is_avoided_even_if_it_was_requested() -> None:
    lost = serving("m1", "west").ended(Outcome.PREEMPTED, "", NOW_S - 1)
    assert region_of(replace(SPOT, region="west"), OFFERS, [lost], NOW_S) != "west"


def test_a_region_that_is_about_to_take_a_machine_is_avoided() -> None:
    noticed = replace(serving("m1", "east"), noticed_unix_s=NOW_S, leaves_at_unix_s=NOW_S + 9)
    assert region_of(SPOT, OFFERS, [noticed], NOW_S) != "east"


def test_a_region_that_took_a_machine_is_better_than_none() -> None:
    lost = serving("m1", "east").ended(Outcome.PREEMPTED, "", NOW_S - 1)
    assert region_of(SPOT, [offer("east")], [lost], NOW_S) == "east"


def test_where_none_was_to_be_had_is_not_asked_again_at_once() -> None:
    failed = record("m1", "east").ended(Outcome.FAILED, "", NOW_S - 0.5)
    assert place(SPOT, [offer("east")], [failed], NOW_S) is None
    assert region_of(SPOT, [offer("east")], [failed], NOW_S + 1) == "east"


def test_each_further_failure_doubles_the_pause() -> None:
    failed = [record(f"m{n}").ended(Outcome.FAILED, "", NOW_S) for n in range(1, 5)]
    assert held_until(failed, NOW_S) == NOW_S + 8.0
    assert wary_until(failed, NOW_S) == 0.0


def test_after_many_failures_in_a_row_no_region_is_asked_for_a_while() -> None:
    failed = [record(f"m{n}", f"r{n}").ended(Outcome.FAILED, "", NOW_S) for n in range(1, 6)]
    assert place(SPOT, OFFERS, failed, NOW_S + 31) is None
    assert place(SPOT, OFFERS, failed, NOW_S + 33) is not None
    assert place(SPOT, OFFERS, [*failed, replace(serving("m9"), served_unix_s=NOW_S + 1)], NOW_S + 2) is not None


def test_nothing_that_fits_is_an_error_that_says_what_comes_nearest() -> None:
    with pytest.raises(LocalError):
        place(replace(SPOT, hardware=Hardware(cpus=512)), OFFERS, [], NOW_S)
