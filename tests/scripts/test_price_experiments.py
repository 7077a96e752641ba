"""Price experiments: their tables and the shipped prices."""

from __future__ import annotations

from argparse import Namespace

import availability
import numpy as np
import table1
from experiment import OUTPUT
from machine import machine_state


def test_the_page_of_table_one_is_of_the_shipped_prices() -> None:
    shown = (OUTPUT / "table1.md").read_text()
    assert shown.startswith(table1.measure(Namespace()).to_text(machine_state()))


def test_every_application_of_the_paper_has_its_three_prices_next_to_ours() -> None:
    needed = table1.applications()
    assert [each.name for each in needed] == list(table1.APPLICATIONS)
    for each in needed:
        one, two, two_spot = each.usd_per_hour
        assert one <= two - one
        assert 0 < two_spot < two
        assert {where.split()[1] for where in each.spot} == set(table1.REGIONS)


def test_replayed_pools_are_up_more_with_more_replicas() -> None:
    cases = list(availability.replay(availability.recorded(), 300, np.random.default_rng(1)))
    for way in availability.WAYS:
        nested = [case for case in cases if case.way == way and (way == "moves" or "bcd".startswith(case.zones))]
        shares = [case.none_up.share for case in sorted(nested, key=lambda case: case.replicas)]
        assert len(shares) == 3
        assert shares == sorted(shares, reverse=True)


def test_zones_that_wait_for_machines_fail_together_more_often_than_independent_ones() -> None:
    cases = availability.replay(availability.recorded(), 34, np.random.default_rng(1))
    for case in cases:
        if case.way == "stays" and case.replicas > 1:
            assert case.independent is not None
            assert case.none_up.share > case.independent
