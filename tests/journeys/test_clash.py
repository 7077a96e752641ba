"""Two nodes with one identity: the older one keeps its place, and both are told."""

from __future__ import annotations

import pytest

from gdp.client.attachment import attachment_waits
from gdp.client.member import Member
from gdp.client.rib_host import RibHost
from gdp.control.waiting import WaitReason
from gdp.errors import DropReason
from gdp.limits import CLAIM_LEASE_S, DEAD_S
from gdp.simulation.memory import Cable
from gdp.simulation.world import World
from gdp.switch.machine import Switch
from gdp.switch.table import Table
from gdp.trust.right import Right
from tests.journeys.flows import ROBOT, SERVER, advertise, flowing, ring

TWIN, ELSEWHERE = "twin", "nuc2"


def add_twin(world: World, switch: str) -> Member:
    """Start a second node with the robot's keys at another switch of its domain."""
    identity = world.identities[ROBOT]
    member = Member(identity, world.policy("school"), world._settings())
    world.members[TWIN] = member
    world.network.add(TWIN, member)
    world.leads[TWIN] = world.network.connect(switch, TWIN, Cable(0.0001))
    return member


def add_twin_switch(world: World, of: str, at: str) -> Switch:
    """Start a second switch with the keys of one, on a cable to another switch."""
    table = Table()
    domain = world.topology.domain_of(of).label
    twin = Switch(world.identities[of], world.policy(domain), table, world._settings())
    world.switches[TWIN] = twin
    world.network.add(TWIN, twin, table)
    world.network.connect(at, TWIN, Cable(0.0005))
    return twin


def add_twin_rib(world: World, label: str, at: str) -> RibHost:
    """Start a second RIB with the keys of one at another switch."""
    host = world._rib(label)
    world.network.add(TWIN, host)
    world.leads[TWIN] = world.network.connect(at, TWIN, Cable(0.0001))
    return host


def waits_in_use(host: RibHost | Member, now_s: float) -> bool:
    return WaitReason.IN_USE in {wait.reason for wait in attachment_waits(host.attachment, now_s)}


def own_refusal(member: Member) -> DropReason | None:
    return next(each.refused for each in member.attachment.claims if each.right is Right.ATTACH)


def place_of(world: World) -> str:
    """Return the switch at which the RIB of the school knows the robot to be."""
    name = world.identities[ROBOT].name
    (route,) = world.ribs["school"].rib._store.routes(name)
    return next(label for label, switch in world.switches.items() if switch.name == route.switch)


def keeps_its_place(world: World, member: Member) -> None:
    """Let three leases pass; the member stays attached."""
    world.network.run(3 * world.lease_s + 1)
    assert member.attachment.is_attached


def test_the_older_of_two_nodes_keeps_serving_past_three_leases_and_both_are_told() -> None:
    world = ring()
    flow = advertise(world)
    twin = add_twin(world, ELSEWHERE)
    assert world.network.run(3, lambda: own_refusal(twin) is DropReason.IN_USE)
    older = world.members[ROBOT].attachment
    assert world.network.run(3, lambda: older.rival_at == world.switches[ELSEWHERE].name)
    for _ in range(int(3 * CLAIM_LEASE_S)):
        world.network.run(1)
        assert place_of(world) == "nuc1"
    flow.read_by(SERVER)
    world.network.run(2)
    flow.outlive()
    assert older.is_attached
    assert older.clashes > 0
    assert own_refusal(twin) is DropReason.IN_USE
    assert twin.attachment.clashes > 0
    assert world.ribs["school"].rib._store.routes(flow.topic.name)


def test_when_the_older_node_dies_the_younger_is_taken() -> None:
    world = ring()
    twin = add_twin(world, ELSEWHERE)
    world.network.run(3)
    world.network.stop(ROBOT)
    assert world.network.run(DEAD_S + 4, lambda: twin.attachment.is_attached)
    assert place_of(world) != "nuc1"
    keeps_its_place(world, twin)


def test_a_node_that_is_killed_and_started_at_another_switch_is_taken_when_its_neighbour_is_known_to_be_dead() -> None:
    world = ring()
    world.network.stop(ROBOT)
    twin = add_twin(world, ELSEWHERE)
    assert world.network.run(DEAD_S + 0.6, lambda: twin.attachment.is_attached)
    keeps_its_place(world, twin)


def test_a_node_whose_old_switch_does_not_answer_is_taken() -> None:
    world = ring()
    world.network.stop("nuc1")
    twin = add_twin(world, ELSEWHERE)
    assert world.network.run(6, lambda: twin.attachment.is_attached)
    keeps_its_place(world, twin)


def test_at_one_switch_the_older_of_two_nodes_keeps_its_place_and_both_are_told() -> None:
    world = ring()
    flow = flowing(world)
    twin = add_twin(world, "nuc1")
    assert world.network.run(3, lambda: waits_in_use(twin, world.network.now.mono_s))
    assert not twin.attachment.is_attached
    flow.outlive()
    older = world.members[ROBOT].attachment
    assert older.greeter.clash_told_by == world.switches["nuc1"].name
    assert twin.attachment.greeter.clashes > 0
    world.network.stop(ROBOT)
    assert world.network.run(DEAD_S + 2, lambda: twin.attachment.is_attached)


def test_the_older_of_two_ribs_serves_and_both_are_told() -> None:
    world = ring()
    flow = flowing(world)
    older = world.ribs["school"]
    twin = add_twin_rib(world, "school", "nuc1")
    assert world.network.run(3, lambda: waits_in_use(twin, world.network.now.mono_s))
    assert world.network.run(8, lambda: older.attachment.greeter.clashes > 0)
    flow.outlive()
    assert twin.attachment.switch is None
    assert older.attachment.switch is not None
    assert twin.rib.names == 0
    world.network.stop(world.rib_node("school"))
    assert world.network.run(DEAD_S + 4, lambda: twin.attachment.switch is not None)
    assert world.network.run(20, lambda: twin.rib.names > 0)


@pytest.mark.parametrize("at", ["nuc1", "nuc3", "nuc5"])
def test_the_older_of_two_switches_keeps_its_place_and_both_are_told(at: str) -> None:
    world = ring()
    there, back = flowing(world), flowing(world, "/answers", SERVER, (ROBOT,))
    older = world.switches["nuc2"]
    twin = add_twin_switch(world, "nuc2", at)
    assert world.network.run(
        5, lambda: twin.is_displaced or WaitReason.IN_USE in {w.reason for w in twin.waits((), 0.0)}
    )
    assert world.network.run(5, lambda: older.greeter.clashes > 0)
    there.outlive()
    back.outlive()
    assert not older.is_displaced
    assert twin.greeter.clashes > 0


def test_two_switches_with_one_identity_that_meet_when_a_link_comes_back_leave_the_older_one() -> None:
    world = ring()
    for cut in (("nuc3", "nuc4"), ("nuc5", "nuc1")):
        world.network.set_link(world.cables[frozenset(cut)], up=False)
    world.network.run(3)
    twin = add_twin_switch(world, "nuc2", "nuc5")
    world.network.run(3)
    assert twin.greeter.all_up()
    older = world.switches["nuc2"]
    world.network.set_link(world.cables[frozenset(("nuc3", "nuc4"))], up=True)
    assert world.network.run(5, lambda: twin.is_displaced)
    assert not older.is_displaced
    assert older.greeter.clashes > 0
    flowing(world).outlive()


def test_a_switch_that_is_restarted_is_nobodys_rival() -> None:
    world = ring()
    flow = flowing(world)
    world.restart_switch("nuc2")
    world.network.run(3)
    flow.outlive()
    assert world.switches["nuc2"].greeter.clashes == 0
    assert all(switch.greeter.rivals.refusals == 0 for switch in world.switches.values())


def test_a_switch_whose_death_not_all_neighbours_have_noticed_is_nobodys_rival() -> None:
    world = ring()
    flow = flowing(world)
    world.network.stop("nuc2")
    world.network.set_link(world.cables[frozenset(("nuc1", "nuc2"))], up=False)  # nuc3 does not know yet
    world.network.set_link(world.cables[frozenset(("nuc1", "nuc2"))], up=True)
    world.restart_switch("nuc2")
    world.network.run(3)
    flow.outlive()
    assert world.switches["nuc2"].greeter.clashes == 0


def test_the_older_of_two_nodes_keeps_serving_when_the_other_one_is_in_another_domain() -> None:
    world = ring()
    there, back = flowing(world), flowing(world, "/answers", SERVER, (ROBOT,))
    twin = add_twin(world, "nuc5")
    assert world.network.run(5, lambda: own_refusal(twin) is DropReason.IN_USE)
    there.outlive()
    back.outlive()
    assert not twin.attachment.is_attached
    assert world.members[ROBOT].attachment.clashes > 0
    assert world.members[ROBOT].attachment.rival_at == world.switches["nuc5"].name
