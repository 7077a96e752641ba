"""Lookup of a name by a switch, for a tool on its machine: what the RIB answers, and why it may not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from gdp.intervals import ADVERTISEMENT
from gdp.names import Name
from gdp.state.name_lookup import SwitchLookups, rib_lookup
from lab.simulation import Simulation
from lab.topology import ring5
from tests.journeys.flows import advertise

pytestmark = pytest.mark.momentary("a lookup ends within seconds, no lease matters")

SWITCH = "nuc3"
UNKNOWN = Name(b"\xab" * 32)


def attached() -> Simulation:
    """Return the ring with all its nodes attached, and its RIBs no longer new."""
    world = Simulation(topology=ring5())
    assert world.run_until_attached()
    world.network.run(5.0)
    return world


def lookup(world: Simulation, name: Name) -> Mapping[str, object]:
    """Ask a switch until its RIB has answered, as the command does."""
    lookups = SwitchLookups(world.switches[SWITCH])
    for _ in range(200):
        answer = lookups.lookup(name, world.network.now)
        if answer["state"] != "asked":
            return answer
        world.network.send_pending(SWITCH)
        world.network.run(0.05)
    raise AssertionError("the lookup did not end")


def advertisers(answer: Mapping[str, object]) -> list[dict[str, Any]]:
    """Return the rows of an answer."""
    rows = answer["advertisers"]
    assert isinstance(rows, list)
    return rows


def test_a_switch_of_another_domain_learns_who_publishes_a_name() -> None:
    world = attached()
    flow = advertise(world, "/scan")
    world.network.run(2.0)
    answer = lookup(world, flow.topic.name)
    (row,) = advertisers(answer)
    assert (answer["state"], row["right"], row["advertiser"]) == ("answered", "publish", flow.member.name.to_text())
    assert 0 < row["left_s"] <= ADVERTISEMENT.lease_s
    assert row["delegated_by"] == [flow.topic.name.to_text()]  # the name stands for its owner
    assert answer["rib"] == world.switches[SWITCH].rib.to_text()  # type: ignore[union-attr]


def test_a_name_that_no_node_advertises_is_answered_as_such() -> None:
    answer = lookup(attached(), UNKNOWN)
    assert (answer["state"], answer["advertisers"]) == ("answered", [])


def test_a_lookup_may_be_repeated_and_asks_again() -> None:
    world = attached()
    assert lookup(world, UNKNOWN)["state"] == "answered"
    world.network.run(1.0)
    assert lookup(world, UNKNOWN)["state"] == "answered"


def test_a_switch_whose_rib_is_silent_states_that() -> None:
    world = attached()
    for label in list(world.ribs):
        world.kill_rib(label)
    assert lookup(world, UNKNOWN)["state"] in ("no-answer", "no-rib")


def test_a_rib_states_what_it_stores() -> None:
    world = attached()
    flow = advertise(world, "/scan")
    world.network.run(2.0)
    answers = [rib_lookup(host.rib, host.name, flow.topic.name, world.network.now) for host in world.ribs.values()]
    assert any(answer["advertisers"] for answer in answers)
    assert {answer["state"] for answer in answers} == {"stored"}
