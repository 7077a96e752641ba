"""Preemption traces: uptime, downtime and recovery of replicas and pools."""

from __future__ import annotations

import numpy as np
from spot_trace import (
    Trace,
    none_up,
    outages,
    pool_down,
    replica_down,
    share_with_interval,
)


def trace(text: str, zone: str = "a") -> Trace:
    return Trace.from_document(zone, {"metadata": {"gap_seconds": 10}, "data": [int(each) for each in text]})


def drawn(steps: object) -> str:
    return "".join("1" if each else "0" for each in np.asarray(steps))


def test_a_machine_is_preempted_where_none_is_available_any_more() -> None:
    assert trace("0001100011").preemptions == [3, 8]
    assert trace("000").preemptions == []


def test_a_replica_that_stays_is_down_until_it_has_recovered() -> None:
    assert drawn(replica_down(trace("0010000110"), 20)) == "0011100111"


def test_a_replica_that_is_replaced_elsewhere_is_down_for_the_recovery_only() -> None:
    assert drawn(outages(trace("0011111000"), 15)) == "0011000000"


def test_a_pool_that_moves_is_down_while_no_zone_has_capacity_and_until_it_has_recovered() -> None:
    one, other = trace("0011110000"), trace("0000110000", "b")
    assert drawn(pool_down([one, other], 1, 10)) == "0010111000"
    assert drawn(pool_down([one, other], 2, 10)) == "0000111000"


def test_none_is_up_when_all_are_down() -> None:
    assert drawn(none_up([trace("0110").taken, trace("0011").taken])) == "0010"


def test_the_interval_holds_the_share_and_narrows_with_the_length() -> None:
    chance = np.random.default_rng(1)
    short, long = (share_with_interval(chance.random(size) < 0.2, 10, 400, chance) for size in (300, 30_000))
    for each in (short, long):
        assert each.low <= each.share <= each.high
    assert long.high - long.low < short.high - short.low
