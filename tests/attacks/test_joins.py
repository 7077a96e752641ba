"""Neighbour switch that advertises the location of another's publisher: without proof it moves no tree."""

from __future__ import annotations

import pytest

from gdp.control.join import Join
from gdp.control.neighbour import Neighbour
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.switch.core import SwitchCore
from gdp.switch.trees import Tree
from lab.simulation import Simulation
from tests.journeys.flows import SERVER, Flow, flowing, ring
from tests.journeys.test_attacks import counted, still_flows


def aside(world: Simulation, flow: Flow) -> tuple[SwitchCore, Tree, Neighbour, Identity]:
    """Return the reader's switch, its tree, a neighbour off the tree's path, and that neighbour's identity."""
    reader = world.members[SERVER].name
    (home,) = (
        each for each in world.switches.values() if any(a.advertisement.node == reader for a in each.attached.all())
    )
    (tree,) = home.multicast.trees.of_topic(flow.topic.name)
    switches = [each for each in home.hello_protocol.neighbours.all_up() if each.role is Role.SWITCH]
    (liar,) = (each for each in switches if each.name != tree.upstream_name)
    (identity,) = (each for each in world.identities.values() if each.name == liar.name)
    return home, tree, liar, identity


@pytest.mark.parametrize("proof", ["none", "of the true place", "of another topic"])
def test_x03_a_join_that_leads_elsewhere_moves_no_tree(proof: str) -> None:
    world = ring()
    flow = flowing(world)
    home, tree, liar, identity = aside(world, flow)
    (label,) = (each for each, machine in world.switches.items() if machine is home)
    upstream, true_place, version = tree.upstream, tree.switch, tree.version
    lie = next(each.name for each in world.switches.values() if each.name not in (home.name, tree.switch))
    shown = {"none": b"", "of the true place": tree.proof, "of another topic": identity.membership}[proof]
    join = Join(
        topic=tree.topic,
        publisher=tree.publisher,
        switch=lie,
        domain=tree.domain,
        allowed=tree.allowed,
        mtu=1_500,
        lease_s=7.0,
        evidence=tree.evidence,
        session=home.hello_protocol.ports[liar.port].echo,
        sequence=1 << 60,
        version=version + 1_000,
        sender_session=liar.nonce,
        proof=shown,
    )
    before = counted(world)
    frames = world.switches["nuc1"].state.outbox.fragmenter.split(
        Kind.JOIN, join.to_wire(identity.name, identity.key), 1_500
    )
    for frame in frames:
        world.network.inject(label, liar.port, frame, liar.mac)
    assert (tree.upstream, tree.switch, tree.version) == (upstream, true_place, version)
    gained = counted(world) - before
    assert gained[DropReason.NOT_DELEGATED] + gained[DropReason.MALFORMED] == 1
    still_flows(flow)
    flow.outlive()


def test_x03_a_genuine_advertisement_of_the_publisher_says_where_it_is_only_under_its_own_number() -> None:
    world = ring()
    flow = flowing(world)
    home, tree, liar, identity = aside(world, flow)
    (label,) = (each for each, machine in world.switches.items() if machine is home)
    version = tree.version
    join = Join(
        topic=tree.topic,
        publisher=tree.publisher,
        switch=tree.switch,
        domain=tree.domain,
        allowed=tree.allowed,
        mtu=1_500,
        lease_s=7.0,
        evidence=tree.evidence,
        session=home.hello_protocol.ports[liar.port].echo,
        sequence=1 << 60,
        version=version + (1 << 40),
        sender_session=liar.nonce,
        proof=tree.proof,
    )
    for frame in world.switches["nuc1"].state.outbox.fragmenter.split(
        Kind.JOIN, join.to_wire(identity.name, identity.key), 1_500
    ):
        world.network.inject(label, liar.port, frame, liar.mac)
    assert tree.version == version
    still_flows(flow)
    flow.outlive()
