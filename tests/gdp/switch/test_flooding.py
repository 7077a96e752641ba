"""Flooding of link states between switches: each reaches its intended switches and no others."""

from __future__ import annotations

from dataclasses import replace

from gdp.control.hello import DIGEST_BYTES
from gdp.control.link_state import LinkState, Scope
from gdp.errors import DropReason
from gdp.frame.codec import HEADER_BYTES, Flag, Header, Kind, encode
from gdp.intervals import LINK_STATE
from gdp.limits import HOPS_MAX
from gdp.names import ZERO
from lab.simulation import Simulation
from tests.journeys.flows import ring


def say(world: Simulation, state: LinkState, by: str, to: str, port: int = 0) -> None:
    """Let a neighbour of ``to`` forward a link state that ``by`` signed."""
    identity = world.identities[by]
    state = replace(state, said_unix_s=int(world.network.now.unix_s))
    wire = state.to_wire(identity.name, identity.key, identity.membership)
    header = Header(Kind.LINK_STATE, Flag.LAST, HOPS_MAX, 0, len(wire), 1 << 40, 0, 1, 9, ZERO, identity.name)
    mac = world.network._nodes[to].ports[port][2].mac
    assert len(encode(header)) == HEADER_BYTES
    world.network.inject(to, port, encode(header) + wire, mac)
    world.network.run(0.2)


def origins(world: Simulation, label: str, scope: Scope) -> set[bytes]:
    return {bytes(each.origin) for each in world.switches[label]._flooding.link_states.states(scope)}


def test_the_inside_of_a_domain_is_known_in_it_alone() -> None:
    world = ring()
    world.network.run(1)
    assert origins(world, "nuc1", Scope.DOMAIN) == {world.identities[each].name for each in ("nuc1", "nuc2")}
    assert origins(world, "nuc3", Scope.DOMAIN) == {world.identities["nuc3"].name}


def test_borders_are_known_everywhere() -> None:
    world = ring()
    world.network.run(1)
    everyone = {bytes(world.identities[each].name) for each in world.topology.nodes}
    assert all(origins(world, each, Scope.BORDER) == everyone for each in world.switches)


def test_an_inside_state_that_leaves_its_domain_is_refused() -> None:
    world = ring()
    nuc2 = world.identities["nuc2"]
    state = LinkState(
        origin=nuc2.name,
        domain=nuc2.root.domain,
        scope=Scope.DOMAIN,
        sequence=1_810_000_000_000,
        links=(),
        inside=(),
        ribs=(),
    )
    say(world, state, "nuc2", "nuc3")
    assert world.switches["nuc3"].drops()[DropReason.WRONG_DOMAIN] == 1
    assert bytes(nuc2.name) not in origins(world, "nuc3", Scope.DOMAIN)


def test_ones_own_state_of_an_earlier_life_is_outdone() -> None:
    world = ring()
    nuc1 = world.identities["nuc1"]
    ahead = 1_810_000_000_000
    say(
        world,
        LinkState(
            origin=nuc1.name, domain=nuc1.root.domain, scope=Scope.DOMAIN, sequence=ahead, links=(), inside=(), ribs=()
        ),
        "nuc1",
        "nuc1",
    )
    known = world.switches["nuc2"]._flooding.link_states
    assert known.sequence_of(nuc1.name, Scope.DOMAIN) > ahead
    assert any(each.links for each in known.states(Scope.DOMAIN) if each.origin == nuc1.name)


def test_a_state_played_back_changes_nothing_and_goes_no_further() -> None:
    world = ring()
    nuc2 = world.identities["nuc2"]
    before = world.switches["nuc1"]._flooding.link_states.version
    say(
        world,
        LinkState(
            origin=nuc2.name, domain=nuc2.root.domain, scope=Scope.DOMAIN, sequence=1, links=(), inside=(), ribs=()
        ),
        "nuc2",
        "nuc1",
    )
    assert world.switches["nuc1"]._flooding.link_states.version == before


def test_a_switch_that_is_gone_is_forgotten_and_the_others_are_not() -> None:
    world = ring(lease_s=20.0)  # of names, which are not the subject
    world.network.stop("nuc3")
    world.network.run(LINK_STATE.lease_s + LINK_STATE.refresh_s + 1)
    gone = bytes(world.identities["nuc3"].name)
    assert gone not in origins(world, "nuc1", Scope.BORDER)
    assert len(origins(world, "nuc1", Scope.BORDER)) == 4


def test_neighbours_that_missed_a_flood_catch_up_by_their_digests() -> None:
    world = ring()
    sim_link = world.cables[frozenset(("nuc1", "nuc2"))]
    world.network.run(1)
    sim_link.loss = 1.0
    world.network.set_link(world.cables[frozenset(("nuc3", "nuc4"))], up=False)
    world.network.run(0.4)
    sim_link.loss = 0.0
    world.network.run(3)
    one, two = (world.switches[each]._flooding.link_states for each in ("nuc1", "nuc2"))
    assert one.digest(one._domain) == two.digest(two._domain)


def test_a_port_with_several_switches_shows_what_all_of_them_should_have() -> None:
    world = ring()
    world.network.run(1)
    nuc1, link_states = world.switches["nuc1"], world.switches["nuc1"].paths.link_states
    (port,) = (
        port
        for port in nuc1.hello_protocol.ports.values()
        if any(each.name == world.identities["nuc2"].name for each in port.neighbours.values())
    )
    (inside,) = port.neighbours.values()
    port.neighbours[ZERO] = replace(inside, name=ZERO)
    assert link_states.digest_for(port) == link_states.digest(inside.domain) != bytes(DIGEST_BYTES)
    port.neighbours[ZERO] = replace(inside, name=ZERO, domain=ZERO)
    assert link_states.digest_for(port) == bytes(DIGEST_BYTES)


def test_a_switch_that_restarts_is_the_last_choice_until_its_trees_are_set_up() -> None:
    world = ring()
    world.network.run(1)

    def costs() -> list[int]:
        states = world.switches["nuc3"]._flooding.link_states.states(Scope.BORDER)
        return [link.cost for each in states if each.origin == world.identities["nuc1"].name for link in each.links]

    before = costs()
    world.restart_switch("nuc1")
    assert world.network.run(1.5, lambda: bool(costs()) and min(costs()) >= 1 << 20)
    assert world.network.run(3.0, lambda: costs() == before)
