"""Two nodes with one identity: the older one keeps its place, and both are told."""

from __future__ import annotations

from gdp.client.member import Member
from gdp.errors import DropReason
from gdp.limits import CLAIM_LEASE_S, DEAD_S
from gdp.testbed.memory import Cable
from gdp.testbed.world import World
from gdp.trust.right import Right
from tests.journeys.flows import ROBOT, advertise, ring

TWIN, ELSEWHERE = "twin", "nuc2"


def add_twin(world: World, switch: str) -> Member:
    """Start a second node with the robot's keys at another switch of its domain."""
    identity = world.identities[ROBOT]
    member = Member(identity, world.policy("school"), world._settings())
    world.members[TWIN] = member
    world.network.add(TWIN, member)
    world.leads[TWIN] = world.network.connect(switch, TWIN, Cable(0.0001))
    return member


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
