"""Leaves (a robot's own switch, a rented machine) that would carry more than the traffic of their own nodes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest

from gdp.control.join import Join
from gdp.control.link_state import Adjacency, AttachedRib, LinkState, Scope
from gdp.control.waiting import WaitReason
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.validity import Validity
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert
from lab.network import SimLink
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import Flow, Tap, flowing
from tests.journeys.test_attacks import counted, mac_of

TALKER, LISTENER, ROBOT = "left/talker", "right/listener", "leaf/robot"
LEASE_S = 2.5
DEAR, CHEAP = 100, 1


def detour(*, far: bool = False) -> Simulation:
    """Return a network whose cheap path between two switches leads through a leaf, the dear one through a third switch.

    ::

        left (talker, RIB) -- 100 -- middle -- 100 -- right (listener)
              `--------- 1 -- leaf (robot) -- 1 --------'

    Args:
        far: ``right`` is of another domain, so that the leaf stands between two.
    """
    home = ("left", "middle", "leaf") if far else ("left", "middle", "leaf", "right")
    topology = Topology(
        links=(
            Link("left", "middle", cost=DEAR), Link("middle", "right", cost=DEAR),
            Link("left", "leaf", cost=CHEAP), Link("leaf", "right", cost=CHEAP),
        ),
        domains=(DomainPlan("home", home), *([DomainPlan("away", ("right",), upper="home")] if far else [])),
        attachments=(
            Attachment("left", "rib", "rib"), Attachment("left", "proxy", "talker"),
            Attachment("leaf", "proxy", "robot"), Attachment("right", "proxy", "listener"),
            *([Attachment("right", "rib", "rib")] if far else []),
        ),
    )  # fmt: skip
    world = Simulation(topology=topology, lease_s=LEASE_S, leaves=("leaf",))
    assert world.run_until_attached()
    return world


def first_to(world: Simulation, at: str, to: str) -> str | None:
    """Return the switch through which another one is reached, or None."""
    switch, target = world.switches[at], world.identities[to]
    way = switch.paths.to_switch(target.name, target.root.domain, switch.state.policy.transit | {target.root.domain})
    return next((label for label, each in world.switches.items() if way and each.name == way.first), None)


def say(world: Simulation, state: LinkState, liar: Identity, to: str, port: int) -> None:
    """Hand the liar's link state to a neighbour."""
    wire = state.to_wire(liar.name, liar.key, liar.membership)
    for frame in world.switches["leaf"].state.outbox.fragmenter.split(Kind.LINK_STATE, wire, 1_500):
        world.network.inject(to, port, frame, mac_of(world, to, port))
    world.network.run(1.0)


def state_of(world: Simulation, switch: str) -> LinkState:
    """Return the newest link state of a switch in its domain, one number on."""
    machine = world.switches[switch]
    states = machine._flooding.link_states.states(Scope.DOMAIN)
    (own,) = (each for each in states if each.origin == machine.name)
    return replace(own, sequence=own.sequence + 1)


def arrives(flow: Flow, reader: str) -> bool:
    """Publish a message; return whether it comes to a reader."""
    flow.collect()
    before = len(flow.got[reader])
    flow.publish(b"one more")
    return flow.world.network.run(3, lambda: flow.has(reader, before + 1))


def test_l01_a_leaf_on_the_cheapest_way_carries_its_own_nodes_only() -> None:
    world = detour()
    taps = [Tap("leaf", to) for to in ("left", "right")]
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    world.network.run(2)
    assert first_to(world, "left", "right") == first_to(world, "right", "left") == "middle"
    assert first_to(world, "left", "leaf") == first_to(world, "right", "leaf") == "leaf"
    world.network.taps += taps
    flow.stream(50, 0.02)
    assert world.network.run(5, lambda: flow.has(LISTENER, 50))
    assert [tap.count(Kind.DATA) for tap in taps] == [0, 0]
    assert set(flow.hops(LISTENER)) == {3}
    own = flowing(world, "/pose", ROBOT, (TALKER, LISTENER))
    assert arrives(own, LISTENER)
    assert world.network.run(3, lambda: own.has(TALKER, 1))
    assert own.hops(LISTENER) == own.hops(TALKER) == [2]
    flow.outlive()
    own.outlive()


def test_l02_a_leaf_that_lists_links_to_all_switches_attracts_no_traffic() -> None:
    world = detour()
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    leaf = world.identities["leaf"]
    before = {(at, to): first_to(world, at, to) for at in ("left", "middle", "right") for to in ("left", "right")}
    everybody = tuple(sorted(Adjacency(each.name, leaf.root.domain, 1, 9_000) for each in world.switches.values()))
    tap = Tap("left", "leaf")
    for scope in Scope:
        said = replace(state_of(world, "leaf"), scope=scope, links=everybody, inside=())
        if scope is Scope.BORDER:
            said = replace(said, inside=everybody, members=tuple(each.name for each in world.switches.values()))
        say(world, said, leaf, "left", 1)
    assert {(at, to): first_to(world, at, to) for at, to in before} == before
    assert counted(world)[DropReason.THROUGH_LEAF] >= 1  # as a border
    world.network.taps.append(tap)
    assert arrives(flow, LISTENER)
    assert tap.count(Kind.DATA) == 0
    flow.outlive()


def test_l03_where_the_only_way_leads_through_a_leaf_frames_stop_and_it_is_said() -> None:
    world = detour()
    flow = flowing(world, source=TALKER, readers=(LISTENER, ROBOT))
    assert arrives(flow, LISTENER)
    world.network.run(2)
    tap = Tap("leaf", "right")
    world.network.set_link(world.cables[frozenset(("left", "middle"))], up=False)
    world.network.run(3)
    world.network.taps.append(tap)
    assert first_to(world, "left", "right") is None
    assert not arrives(flow, LISTENER)
    assert tap.count(Kind.DATA) == 0
    waits = {label: {wait.reason for wait in world.switches[label].waits((), world.network.now.mono_s)}
             for label in world.switches}  # fmt: skip
    assert {label for label, reasons in waits.items() if WaitReason.THROUGH_LEAF in reasons} == {
        "left", "middle", "right",
    }  # fmt: skip
    before, left = counted(world)[DropReason.THROUGH_LEAF], world.switches["left"]
    left.unicast.send([bytes(96)], world.switches["right"].name, left.name, world.network.now.mono_s)
    assert counted(world)[DropReason.THROUGH_LEAF] == before + 1
    assert world.switches["right"].multicast.drops[DropReason.THROUGH_LEAF] > 0  # it cannot join the talker's tree
    flow.outlive(ROBOT)  # the leaf's own node is reached as before
    world.network.set_link(world.cables[frozenset(("left", "middle"))], up=True)
    world.network.run(10)
    assert arrives(flow, LISTENER)
    world.network.run(3)  # lost messages are repaired
    flow.outlive()


@pytest.mark.momentary("the forged join bears the leaf's own key: what it says later is older")
def test_l04_a_leaf_that_joins_for_a_reader_elsewhere_gets_no_copies() -> None:
    world = detour()
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    world.network.run(2)
    left, leaf = world.switches["left"], world.identities["leaf"]
    (tree,) = left.multicast.trees.of_topic(flow.topic.name)
    neighbour = left.hello_protocol.neighbours.get(1, leaf.name)
    assert neighbour is not None
    join = Join(
        topic=tree.topic,
        publisher=tree.publisher,
        switch=left.name,
        domain=left.state.policy.own,
        allowed=tree.allowed,
        mtu=1_500,
        lease_s=5.0,
        evidence=tree.evidence,
        session=left.hello_protocol.ports[1].echo,
        sequence=1 << 50,
        version=tree.version,
        sender_session=neighbour.nonce,
        proof=tree.proof,
    )
    tap = Tap("left", "leaf")
    world.network.taps.append(tap)
    for frame in world.switches["leaf"].state.outbox.fragmenter.split(
        Kind.JOIN, join.to_wire(leaf.name, leaf.key), 1_500
    ):
        world.network.inject("left", 1, frame, mac_of(world, "left", 1))
    assert arrives(flow, LISTENER)
    assert left.drops()[DropReason.THROUGH_LEAF] == 1
    assert tap.count(Kind.DATA) == 0


def test_l05_a_leaf_is_no_border_and_no_neighbour_of_another_domain() -> None:
    world = detour(far=True)
    flow = flowing(world, source=TALKER, readers=(LISTENER, ROBOT))
    right, leaf = world.switches["right"], world.identities["leaf"]
    assert right.hello_protocol.neighbours.get(1, leaf.name) is None
    assert right.drops()[DropReason.THROUGH_LEAF] > 0
    waits = right.waits((), world.network.now.mono_s)
    assert [wait.refused for wait in waits if wait.reason is WaitReason.STRANGER] == [DropReason.THROUGH_LEAF]
    border = replace(
        state_of(world, "leaf"), scope=Scope.BORDER, members=(world.switches["left"].name,),
        links=(Adjacency(right.name, right.state.policy.own, 1, 1_500),),
    )  # fmt: skip
    before = right.drops()[DropReason.THROUGH_LEAF]
    wire = border.to_wire(leaf.name, leaf.key, leaf.membership)
    for frame in world.switches["leaf"].state.outbox.fragmenter.split(Kind.LINK_STATE, wire, 1_500):
        world.network.inject("right", 0, frame, mac_of(world, "right", 0))  # as if its neighbour forwarded it
    assert right.drops()[DropReason.THROUGH_LEAF] > before
    assert not any(each.origin == leaf.name for each in right._flooding.link_states.states(Scope.BORDER))
    assert first_to(world, "right", "left") == "middle"
    flow.outlive()


@pytest.mark.parametrize("signed_by", ["a stranger's root", "another domain's root"])
def test_l06_a_leaf_hosts_no_rib_that_its_own_root_does_not_name(signed_by: str) -> None:
    world = detour(far=True)
    leaf, left = world.identities["leaf"], world.switches["left"]
    keys = (
        Simulation(topology=world.topology, seed=2).identities["rib:home"] if signed_by == "a stranger's root" else None
    )
    rib = keys or world.identities["rib:away"]
    validity = Validity.lasting(world.network.now.unix_s, 600)
    proof = RtCert.make(rib, leaf.name, validity)  # the RIB's owner and the machine's tenant are one
    listed = AttachedRib(rib.name, rib.root.domain, b"session!", membership=rib.membership, rtcert=proof)
    before = left.rib
    say(world, replace(state_of(world, "leaf"), ribs=(listed,)), leaf, "left", 1)
    assert leaf.name not in left.paths._ribs.get(rib.name, {})
    assert left.rib == before
    assert left.drops()[DropReason.MISPLACED] + left.drops()[DropReason.WRONG_DOMAIN] >= 1


def test_l07_frames_in_anothers_name_from_a_leaf_become_no_copies() -> None:
    world = detour()
    tap = Tap(TALKER, "left")
    world.network.taps.append(tap)
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    assert arrives(flow, LISTENER)
    world.network.run(3)  # the tree has settled
    data = next(frame for frame in tap.frames if frame[1] == Kind.DATA)
    for switch, port in (("left", 1), ("right", 1)):
        before = world.network.drops[DropReason.WRONG_SIDE]
        for _ in range(10):
            world.network.inject(switch, port, data, mac_of(world, switch, port))
        assert world.network.drops[DropReason.WRONG_SIDE] == before + 10
    flow.outlive()


def test_l08_a_leaf_that_advertises_for_another_switchs_node_is_refused_by_the_rib() -> None:
    world = detour()
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    leaf = world.switches["leaf"]
    advertisement = world.switches["left"].attached.get(flow.topic.name, flow.member.name)
    assert advertisement is not None
    rib = world.ribs["home"]
    before = rib.drops()[DropReason.NOT_DELEGATED]
    leaf.rib_client.relay(advertisement.advertisement.wire, world.network.now.mono_s)
    world.network.send_pending("leaf")
    world.network.run(1)
    assert rib.drops()[DropReason.NOT_DELEGATED] == before + 1
    assert arrives(flow, LISTENER)
    flow.outlive()


def test_two_leaves_that_are_joined_reach_each_others_nodes_and_pass_nothing_on() -> None:
    topology = Topology(
        links=(Link("hub", "one"), Link("one", "two")),
        domains=(DomainPlan("home", ("hub", "one", "two")),),
        attachments=(
            Attachment("hub", "rib", "rib"), Attachment("hub", "proxy", "desk"), Attachment("one", "proxy", "first"),
        ),
    )  # fmt: skip
    world = Simulation(topology=topology, lease_s=LEASE_S, leaves=("one", "two"))
    assert world.run_until_attached()
    assert first_to(world, "one", "two") == "two"
    assert first_to(world, "hub", "two") is None
    flow = flowing(world, source="hub/desk", readers=("one/first",))
    second = world.add_member("two/second", "two")
    world.network.run(5)
    assert second.attachment.switch is not None
    flow.read_by("two/second")
    assert not world.network.run(3, lambda: flow.is_read_by(2))
    flow.outlive("one/first")


def test_a_leaf_reads_itself_as_one_and_reaches_both_its_sides() -> None:
    world = detour()
    leaf = world.switches["leaf"]
    assert world.identities["leaf"].role is Role.LEAF
    world.network.set_link(world.cables[frozenset(("left", "middle"))], up=False)
    world.network.run(3)
    assert first_to(world, "leaf", "left") == "left"
    assert first_to(world, "leaf", "right") == "right"
    assert first_to(world, "leaf", "middle") == "right"
    assert leaf.paths.members() == frozenset(each.name for each in world.switches.values())


def test_a_node_that_moves_to_a_leaf_and_on_keeps_its_reader() -> None:
    world = detour()
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    flow.stream(300, 0.02, size=100)
    for at_s, to in ((1.0, "leaf"), (3.0, "right"), (4.5, "leaf")):
        world.network.call(at_s, partial(world.roam, TALKER, to))
    assert world.network.run(30, lambda: flow.has(LISTENER, 300))
    assert flow.numbers(LISTENER) == list(range(300))
    flow.outlive()


def test_a_sim_link_to_a_leaf_from_a_second_switch_makes_no_way_through_it() -> None:
    world = detour()
    flow = flowing(world, source=TALKER, readers=(LISTENER,))
    topic = world.topic(flow.name, world.members[ROBOT], [Right.READ])
    world.members[ROBOT].subscribe(topic)
    flow.got[ROBOT] = []
    world.network.send_pending(ROBOT)
    assert world.network.run(5, lambda: flow.is_read_by(2))
    world.network.connect("middle", "leaf", SimLink(), CHEAP)
    world.network.run(3)
    assert first_to(world, "left", "right") == first_to(world, "left", "middle") == "middle"
    assert world.switches["left"].paths.domain_of(Name(world.switches["leaf"].name)) is not None
    flow.outlive()
