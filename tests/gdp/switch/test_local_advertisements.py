"""Advertisements of attached nodes: how often they are relayed while the RIB does not acknowledge them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Final, cast

import pytest

from gdp.names import Name
from gdp.switch.local_advertisements import LocalAdvertisements
from gdp.trust.right import Right

if TYPE_CHECKING:
    from gdp.trust.advertisement import Advertisement

NAME, NODE = Name(b"n" * 32), Name(b"m" * 32)
MAC: Final = b"\x02maddr"


def advertisement(sequence: int) -> Advertisement:
    """Return an advertisement with only what a table of them reads."""
    facts = SimpleNamespace(name=NAME, node=NODE, right=Right.PUBLISH, sequence=sequence, lease_s=60.0)
    return cast("Advertisement", facts)


def relays_s(attached: LocalAdvertisements, from_s: float, until_s: float, trip_s: float = 0.0) -> list[float]:
    """Return when advertisements are relayed."""
    found = []
    for step in range(round((until_s - from_s) * 100)):
        now_s = from_s + step * 0.01
        found += [now_s] * len(attached.due(now_s, trip_s))
    return found


@pytest.mark.parametrize(
    ("trip_s", "expected"),
    [(0.0, [0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4, 2.8]), (0.5, [0, 1, 3, 6.2]), (60.0, [0, 3.2])],
)
def test_relays_are_two_round_trips_apart_and_rarer_behind_a_slow_link(trip_s: float, expected: list[float]) -> None:
    attached = LocalAdvertisements()
    attached.put(advertisement(1), 0, MAC, 0.0)
    found = relays_s(attached, 0, expected[-1] + 0.2, trip_s)
    assert found == pytest.approx(expected, abs=0.1)


def test_a_node_that_repeats_itself_behind_a_slow_link_is_not_relayed_each_time() -> None:
    attached = LocalAdvertisements()
    found = list[float]()
    for half in range(20):
        attached.put(advertisement(half), 0, MAC, half / 2)
        found += relays_s(attached, half / 2, half / 2 + 0.5, trip_s=1.0)
    assert len(found) == 5


def test_a_node_elsewhere_and_one_that_was_acknowledged_are_relayed_at_once() -> None:
    attached = LocalAdvertisements()
    attached.put(advertisement(1), 0, MAC, 0.0)
    relays_s(attached, 0, 5, trip_s=2.0)
    attached.put(advertisement(2), 1, MAC, 5.0)
    assert relays_s(attached, 5, 5.2, trip_s=2.0) == [5.0]
    attached.handle_ack(NAME, NODE, 2)
    attached.put(advertisement(3), 1, MAC, 6.0)
    assert relays_s(attached, 6, 6.2, trip_s=2.0) == [6.0]
