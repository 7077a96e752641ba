"""Switches that falsely advertise a path to another's RIB, proxy or switch: they attract no traffic."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gdp.control.link_state import AttachedRib, LinkState, Scope
from gdp.crypto.identity import Identity
from gdp.crypto.validity import Validity
from gdp.errors import DropReason
from gdp.frame.codec import Kind
from gdp.names import Name
from gdp.trust.rtcert import RtCert
from lab.simulation import Simulation
from tests.journeys.flows import ROBOT, flowing, ring
from tests.journeys.test_attacks import mac_of, still_flows


def liar_of(world: Simulation, switch: str) -> LinkState:
    """Return the newest border link state of a switch, one number on."""
    machine = world.switches[switch]
    states = machine._flooding.link_states.states(Scope.BORDER)
    (own,) = (each for each in states if each.origin == machine.name)
    return replace(own, sequence=own.sequence + 1)


def say(world: Simulation, state: LinkState, liar: Identity) -> None:
    """Hand the liar's link state to nuc1 as its neighbour nuc2 would."""
    wire = state.to_wire(liar.name, liar.key, liar.membership)
    frames = world.switches["nuc2"].state.outbox.fragmenter.split(Kind.LINK_STATE, wire, 1_500)
    for frame in frames:
        world.network.inject("nuc1", 0, frame, mac_of(world, "nuc1"))


@pytest.mark.parametrize(
    ("victim", "rtcert"),
    [
        (ROBOT, "none"),
        (ROBOT, "made by the liar"),
        ("rib:school", "for another switch"),
        pytest.param(ROBOT, "for another switch", marks=pytest.mark.nightly),
        pytest.param("rib:school", "none", marks=pytest.mark.nightly),
        pytest.param("rib:school", "made by the liar", marks=pytest.mark.nightly),
    ],
)
def test_a07_a08_a72_a_switch_that_lists_anothers_rib_or_proxy_draws_none_of_its_frames(
    victim: str, rtcert: str
) -> None:
    world = ring()
    flow = flowing(world)
    nuc1 = world.switches["nuc1"]
    attacked, liar = world.identities[victim], world.identities["nuc5"]
    validity = Validity.lasting(world.network.now.unix_s, 600)
    proof = {
        "none": b"",
        "for another switch": RtCert.make(attacked, nuc1.name, validity),
        "made by the liar": RtCert.make(liar, liar.name, validity),
    }[rtcert]
    lie = AttachedRib(attacked.name, liar.root.domain, b"session!", membership=attacked.membership, rtcert=proof)
    own = AttachedRib(attacked.name, attacked.root.domain, b"session!", membership=attacked.membership, rtcert=proof)
    before = nuc1.rib
    say(world, replace(liar_of(world, "nuc5"), ribs=(lie, own)), liar)
    hosts = nuc1.paths._ribs.get(attacked.name, {})
    assert liar.name not in hosts
    assert nuc1.rib == before
    drops = nuc1.drops()
    assert drops[DropReason.MISPLACED] + drops[DropReason.NOT_DELEGATED] + drops[DropReason.MALFORMED] >= 2
    still_flows(flow)
    flow.outlive()


def test_a07_a_border_that_lists_switches_of_another_domain_is_no_way_to_them() -> None:
    world = ring()
    flow = flowing(world)
    nuc1, liar = world.switches["nuc1"], world.identities["nuc5"]
    nuc3 = world.switches["nuc3"]
    domain = world.identities["nuc3"].root.domain
    before = nuc1.paths.to_switch(nuc3.name, domain, nuc1.state.policy.transit)
    say(world, replace(liar_of(world, "nuc5"), members=(liar.name, nuc3.name, Name(b"m" * 32))), liar)
    assert nuc1.paths.to_switch(nuc3.name, domain, nuc1.state.policy.transit) == before
    assert nuc1.paths.to_switch(Name(b"m" * 32), domain, nuc1.state.policy.transit) != (
        nuc1.paths.to_switch(liar.name, liar.root.domain, nuc1.state.policy.transit)
    )
    still_flows(flow)
    flow.outlive()


def test_a55_joins_of_invented_domains_recompute_no_paths() -> None:
    world = ring()
    paths = world.switches["nuc1"].paths
    target, domain = world.switches["nuc4"].name, world.identities["nuc4"].root.domain
    transit = world.switches["nuc1"].state.policy.transit
    paths.to_switch(target, domain, transit)
    known = len(paths._ways)
    for number in range(100):
        paths.to_switch(target, domain, transit | {Name(number.to_bytes(32, "big"))})
    assert len(paths._ways) == known
