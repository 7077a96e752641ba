"""Two nodes with one identity: the older one keeps its location, and both get a report."""

from __future__ import annotations

import pytest

from gdp.client.attachment import attachment_waits
from gdp.client.participant import Participant
from gdp.client.rib_host import RibHost
from gdp.control.waiting import WaitReason
from gdp.errors import DropReason
from gdp.intervals import NEIGHBOUR, REFUSED_S
from gdp.switch.core import SwitchCore
from gdp.switch.table import Table
from gdp.trust.right import Right
from lab.network import SimLink
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, SERVER, advertise, flowing, outlive_together, ring
from tests.lanes import nightly

CONVERTER, ELSEWHERE = "twin", "nuc2"


def add_converter(world: Simulation, switch: str) -> Participant:
    """Start a second node with the robot's keys at another switch of its domain."""
    identity = world.identities[ROBOT]
    member = Participant(identity, world.policy("school"), world._settings())
    world.members[CONVERTER] = member
    world.network.add(CONVERTER, member)
    world.leads[CONVERTER] = world.network.connect(switch, CONVERTER, SimLink(0.0001))
    return member


def add_converter_switch(world: Simulation, of: str, at: str) -> SwitchCore:
    """Start a second switch with the keys of one, on a cable to another switch."""
    table = Table()
    domain = world.topology.domain_of(of).label
    converter = SwitchCore(world.identities[of], world.policy(domain), table, world._settings())
    world.switches[CONVERTER] = converter
    world.network.add(CONVERTER, converter, table)
    world.network.connect(at, CONVERTER, SimLink(0.0005))
    return converter


def add_converter_rib(world: Simulation, label: str, at: str) -> RibHost:
    """Start a second RIB with the keys of one at another switch."""
    host = world._rib(label)
    world.network.add(CONVERTER, host)
    world.leads[CONVERTER] = world.network.connect(at, CONVERTER, SimLink(0.0001))
    return host


def waits_in_use(host: RibHost | Participant, now_s: float) -> bool:
    return WaitReason.IN_USE in {wait.reason for wait in attachment_waits(host.attachment, now_s)}


def own_refusal(member: Participant) -> DropReason | None:
    return next(each.refused for each in member.attachment.advertisements if each.right is Right.ATTACH)


def place_of(world: Simulation) -> str:
    """Return the switch of the robot according to the RIB of the school."""
    name = world.identities[ROBOT].name
    (route,) = world.ribs["school"].rib.state.store.routes(name)
    return next(label for label, switch in world.switches.items() if switch.name == route.switch)


def keeps_its_place(world: Simulation, member: Participant) -> None:
    """Let three leases pass; the member stays attached."""
    world.network.run(3 * world.lease_s + 1)
    assert member.attachment.is_attached


def test_the_older_of_two_nodes_keeps_serving_past_three_leases_and_both_are_informed() -> None:
    world = ring()
    flow = advertise(world)
    converter = add_converter(world, ELSEWHERE)
    assert world.network.run(3, lambda: own_refusal(converter) is DropReason.IN_USE)
    older = world.members[ROBOT].attachment
    assert world.network.run(3, lambda: older.conflict_at == world.switches[ELSEWHERE].name)
    for _ in range(int(3 * world.lease_s + REFUSED_S)):
        world.network.run(1)
        assert place_of(world) == "nuc1"
    flow.read_by(SERVER)
    world.network.run(2)
    flow.outlive()
    assert older.is_attached
    assert older.clashes > 0
    assert own_refusal(converter) is DropReason.IN_USE
    assert converter.attachment.clashes > 0
    assert world.ribs["school"].rib.state.store.routes(flow.topic.name)


def test_when_the_older_node_dies_the_younger_is_taken() -> None:
    world = ring()
    converter = add_converter(world, ELSEWHERE)
    world.network.run(3)
    world.network.stop(ROBOT)
    assert world.network.run(NEIGHBOUR.lease_s + 4, lambda: converter.attachment.is_attached)
    assert place_of(world) != "nuc1"
    keeps_its_place(world, converter)


def test_a_node_that_is_killed_and_started_at_another_switch_is_taken_when_its_neighbour_is_known_to_be_dead() -> None:
    world = ring(keepalive_ms=None)
    world.network.stop(ROBOT)
    converter = add_converter(world, ELSEWHERE)
    assert world.network.run(NEIGHBOUR.lease_s + 0.6, lambda: converter.attachment.is_attached)
    keeps_its_place(world, converter)


def test_a_node_whose_old_switch_does_not_answer_is_taken() -> None:
    world = ring()
    world.network.stop("nuc1")
    converter = add_converter(world, ELSEWHERE)
    assert world.network.run(6, lambda: converter.attachment.is_attached)
    keeps_its_place(world, converter)


def test_at_one_switch_the_older_of_two_nodes_keeps_its_location_and_both_are_informed() -> None:
    world = ring()
    flow = flowing(world)
    converter = add_converter(world, "nuc1")
    assert world.network.run(3, lambda: waits_in_use(converter, world.network.now.mono_s))
    assert not converter.attachment.is_attached
    flow.outlive()
    older = world.members[ROBOT].attachment
    assert older.hello_protocol.conflicts.clash_reporter == world.switches["nuc1"].name
    assert converter.attachment.hello_protocol.conflicts.clashes > 0
    world.network.stop(ROBOT)
    assert world.network.run(NEIGHBOUR.lease_s + 2, lambda: converter.attachment.is_attached)


def test_the_older_of_two_ribs_serves_and_both_are_informed() -> None:
    world = ring()
    flow = flowing(world)
    older = world.ribs["school"]
    converter = add_converter_rib(world, "school", "nuc1")
    assert world.network.run(3, lambda: waits_in_use(converter, world.network.now.mono_s))
    assert world.network.run(8, lambda: older.attachment.hello_protocol.conflicts.clashes > 0)
    flow.outlive()
    assert converter.attachment.switch is None
    assert older.attachment.switch is not None
    assert converter.rib.names == 0
    world.network.stop(world.rib_node("school"))
    assert world.network.run(NEIGHBOUR.lease_s + 4, lambda: converter.attachment.switch is not None)
    assert world.network.run(20, lambda: converter.rib.names > 0)


@pytest.mark.parametrize("at", ["nuc3", *nightly("nuc1", "nuc5")])
def test_the_older_of_two_switches_keeps_its_location_and_both_are_informed(at: str) -> None:
    world = ring()
    there, back = flowing(world), flowing(world, "/answers", SERVER, (ROBOT,))
    older = world.switches["nuc2"]
    converter = add_converter_switch(world, "nuc2", at)
    assert world.network.run(
        5, lambda: converter.is_displaced or WaitReason.IN_USE in {w.reason for w in converter.waits((), 0.0)}
    )
    assert world.network.run(5, lambda: older.hello_protocol.conflicts.clashes > 0)
    outlive_together(there, back)
    assert not older.is_displaced
    assert converter.hello_protocol.conflicts.clashes > 0


def test_two_switches_with_one_identity_that_meet_when_a_link_comes_back_leave_the_older_one() -> None:
    world = ring()
    for cut in (("nuc3", "nuc4"), ("nuc5", "nuc1")):
        world.network.set_link(world.cables[frozenset(cut)], up=False)
    world.network.run(3)
    converter = add_converter_switch(world, "nuc2", "nuc5")
    world.network.run(3)
    assert converter.hello_protocol.neighbours.all_up()
    older = world.switches["nuc2"]
    world.network.set_link(world.cables[frozenset(("nuc3", "nuc4"))], up=True)
    assert world.network.run(5, lambda: converter.is_displaced)
    assert not older.is_displaced
    assert older.hello_protocol.conflicts.clashes > 0
    flowing(world).outlive()


def test_a_restarted_switch_conflicts_with_no_node() -> None:
    world = ring()
    flow = flowing(world)
    world.restart_switch("nuc2")
    world.network.run(3)
    flow.outlive()
    assert world.switches["nuc2"].hello_protocol.conflicts.clashes == 0
    assert all(switch.hello_protocol.conflicts.refusals == 0 for switch in world.switches.values())


def test_a_switch_whose_death_not_all_neighbours_have_noticed_conflicts_with_no_node() -> None:
    world = ring()
    flow = flowing(world)
    world.network.stop("nuc2")
    world.network.set_link(world.cables[frozenset(("nuc1", "nuc2"))], up=False)  # nuc3 does not know yet
    world.network.set_link(world.cables[frozenset(("nuc1", "nuc2"))], up=True)
    world.restart_switch("nuc2")
    world.network.run(3)
    flow.outlive()
    assert world.switches["nuc2"].hello_protocol.conflicts.clashes == 0


def test_the_older_of_two_nodes_keeps_serving_when_the_other_one_is_in_another_domain() -> None:
    world = ring()
    there, back = flowing(world), flowing(world, "/answers", SERVER, (ROBOT,))
    converter = add_converter(world, "nuc5")
    assert world.network.run(5, lambda: own_refusal(converter) is DropReason.IN_USE)
    outlive_together(there, back)
    assert not converter.attachment.is_attached
    assert world.members[ROBOT].attachment.clashes > 0
    assert world.members[ROBOT].attachment.conflict_at == world.switches["nuc5"].name
