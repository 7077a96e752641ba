"""Snapshots of real cores: what a live view learns of a switch, a RIB and a proxy."""

from __future__ import annotations

import json
from typing import Any

from gdp.control.link_state import Scope
from gdp.state.snapshot import (
    ID_CHARS,
    member_snapshot,
    node_snapshot,
    rib_snapshot,
    short_id,
    switch_snapshot,
    topology_snapshot,
)
from gdp.telemetry.sources import Sources
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.gdp.state.memory_states import member_state, switch_state
from tests.journeys.flows import ROBOT, SERVER, Flow, flowing, row


def ends_of(flow: Flow) -> tuple[str, str, str]:
    """Return the ids of topic, publisher and reader."""
    world, topic = flow.world, flow.world.topic(flow.name, flow.member, [Right.PUBLISH])
    return short_id(topic.name), short_id(flow.member.name), short_id(world.members[SERVER].name)


def snapshots(world: Simulation) -> dict[str, Any]:
    """Return the snapshot of every switch, by its label."""
    return {label: json.loads(json.dumps(switch_snapshot(switch_state(world, label)))) for label in world.switches}


def test_the_trees_of_all_switches_lead_from_the_publisher_to_the_reader() -> None:
    flow = flowing(row())
    flow.publish(b"x")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 1))
    topic, publisher, reader = ends_of(flow)
    steps = {}
    for label, shown in snapshots(flow.world).items():
        here = short_id(flow.world.switches[label].name)
        steps[here] = {
            to
            for name, source, _, _, branches in shown["trees"]
            if (name, source) == (topic, publisher)
            for to in branches
        }
    at, passed = short_id(flow.world.switches["nuc1"].name), 0
    while at != reader:
        (at,) = steps[at]
        passed += 1
    assert passed == 3
    flow.outlive()


def test_a_switch_shows_its_links_and_the_names_of_attached_nodes() -> None:
    flow = flowing(row())
    topic, publisher, _ = ends_of(flow)
    shown = snapshots(flow.world)["nuc1"]
    assert {each["role"] for each in shown["links"]} >= {"switch", "proxy"}
    assert [topic, publisher, "publish"] in shown["names"]
    assert all(len(each["to"]) == ID_CHARS for each in shown["links"])
    flow.outlive()


def test_a_topology_shows_both_ends_of_every_link_of_the_domain() -> None:
    flow = flowing(row())
    switch = flow.world.switches["nuc1"]
    rows = topology_snapshot(switch)["switches"]
    assert isinstance(rows, list)
    assert {row[0] for row in rows} == {
        short_id(each.origin) for scope in Scope for each in switch.paths.link_states.states(scope)
    }
    assert all(len(link) == 3 for _, _, links in rows for link in links)
    flow.outlive()


def test_a_proxy_shows_what_it_publishes_and_a_reader_what_came() -> None:
    flow = flowing(row())
    flow.publish(b"x")
    assert flow.world.network.run(1, lambda: flow.has(SERVER, 1))
    topic, publisher, _ = ends_of(flow)
    sent: Any = member_snapshot(flow.member, [{"name": topic}])
    assert sent["sent"][topic]["messages"] == 1
    assert [topic, "publish", ""] in sent["names"]
    assert sent["flows"] == [{"name": topic}]
    received: Any = member_snapshot(flow.world.members[SERVER])
    assert (received["received"][topic]["messages"], received["received"][topic]["bytes"]) == (1, 1)
    assert publisher != short_id(flow.world.members[SERVER].name)
    flow.outlive()


def test_a_snapshot_holds_no_whole_name() -> None:
    flow = flowing(row())
    member = flow.member
    text = json.dumps([snapshots(flow.world), member_snapshot(member), topology_snapshot(flow.world.switches["nuc2"])])
    for name in (member.name, flow.world.topic(flow.name, member, [Right.PUBLISH]).name):
        assert short_id(name) in text
        assert name.hex() not in text
    flow.outlive()


def test_every_node_shows_its_domain_and_its_drops_by_reason() -> None:
    world = row()
    state = member_state(world, ROBOT)
    shown: Any = node_snapshot(state, Sources(), state.begun_s + 1.0)
    assert (shown["role"], shown["domain_label"], shown["uptime_s"]) == ("proxy", state.identity.root.label, 1.0)
    assert list(shown["drops"].values()) == [2]


def test_a_rib_shows_how_many_routes_it_has() -> None:
    flow = flowing(row())
    for host in flow.world.ribs.values():
        shown: Any = rib_snapshot(host.rib, None)
        assert shown["routes"] == host.rib.names
        assert shown["switch"] is None
    flow.outlive()
