"""Clocks that are an hour off, and link states of dead switches: a restarted node works at once, old state ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import pytest

from gdp.client.rib_host import RibHost
from gdp.control.link_state import Scope
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.intervals import LINK_STATE
from gdp.limits import LINK_STATE_AGE_MAX_S
from gdp.rib.core import RibCore
from gdp.rib.state import RibSettings
from gdp.rib.store import MemoryStore
from gdp.sansio import Timestamps
from gdp.switch.core import SwitchCore
from gdp.switch.lsdb import PAST_S
from gdp.switch.table import Table
from lab.simulation import Simulation
from tests.gdp.switch.net import known, link, state
from tests.journeys.flows import SERVER, Flow, flowing, ring
from tests.journeys.test_attacks import mac_of

HOUR_S = 3_600.0
OTHER_RESTARTS = (("nuc2", 0.0), ("nuc2", HOUR_S), ("nuc4", -HOUR_S), ("nuc4", 0.0))
_M = TypeVar("_M")


def off(machine: _M, by_s: float) -> _M:
    """Give a machine a wrong wall clock."""
    for name in ("add_port", "receive", "port_changed", "handle_timer"):
        method = getattr(machine, name)

        def shifted(*given: object, method: Callable[..., None] = method) -> None:
            *others, now = given
            assert isinstance(now, Timestamps)
            method(*others, now._replace(unix_s=now.unix_s + by_s))

        setattr(machine, name, shifted)
    return machine


def restart_switch(world: Simulation, name: str, by_s: float) -> SwitchCore:
    settings = world._settings()
    settings = replace(settings, first_sequence=settings.first_sequence + int(by_s * 1_000))
    table = Table()
    policy = world.policy(world.topology.domain_of(name).label)
    switch = world.switches[name] = off(SwitchCore(world.identities[name], policy, table, settings), by_s)
    world.network.replace(name, switch, table)
    return switch


def restart_rib(world: Simulation, label: str, by_s: float) -> None:
    settings = world._settings()
    settings = replace(settings, first_sequence=settings.first_sequence + int(by_s * 1_000))
    identity, policy = world.identities[f"rib:{label}"], world.policy(label)
    (domain,) = (each for each in world.topology.domains if each.label == label)
    places = RibSettings(upper=world._upper_names(domain.upper), peers=world._rib_names(label))
    host = world.ribs[label] = off(
        RibHost(identity, policy, RibCore(identity, policy, MemoryStore(), places), settings), by_s
    )
    world.network.replace(world.rib_node(label), host)


def flows_within(flow: Flow, seconds: float) -> bool:
    """Return whether everything published from now on arrives within this time."""
    flow.collect()
    before = len(flow.got[SERVER])
    flow.stream(10, seconds / 20)
    return flow.world.network.run(seconds, lambda: flow.has(SERVER, before + 10))


@pytest.mark.momentary("how soon a flow goes on is the question")
@pytest.mark.parametrize(
    ("switch", "by_s"),
    [
        ("nuc2", -HOUR_S),
        ("nuc4", HOUR_S),
        *(pytest.param(*each, marks=pytest.mark.nightly) for each in OTHER_RESTARTS),
    ],
)
def test_a30_a_switch_that_restarts_with_its_clock_an_hour_off_is_heard_at_once(switch: str, by_s: float) -> None:
    world = ring()
    flow = flowing(world)
    world.network.run(3)
    restart_switch(world, switch, by_s)
    assert flows_within(flow, 4.0)
    assert flows_within(flow, 12.0)  # longer than the lease of branches


@pytest.mark.momentary("how soon a flow goes on is the question")
def test_a30_clocks_an_hour_off_to_both_sides_separate_no_nodes() -> None:
    world = ring()
    flow = flowing(world)
    world.network.run(1)
    restart_switch(world, "nuc3", HOUR_S)
    restart_rib(world, "school", -HOUR_S)
    restart_switch(world, "nuc4", -HOUR_S)
    assert flows_within(flow, 6.0)
    assert flows_within(flow, 12.0)
    restart_switch(world, "nuc3", -HOUR_S)
    restart_switch(world, "nuc4", HOUR_S)
    assert flows_within(flow, 6.0)
    assert flows_within(flow, 12.0)


@pytest.mark.parametrize("off_s", [-HOUR_S, HOUR_S])
def test_a30_a_certificate_holds_at_a_clock_that_is_an_hour_off(off_s: float) -> None:
    validity = Validity(10_000, 20_000)
    for true_s in (10_000, 15_000, 20_000):
        validity.check(true_s + off_s, "certificate")
    with pytest.raises(StatementError):
        validity.check(20_000 + HOUR_S + 1, "certificate")


def buried(world: Simulation, label: str) -> list[bytes]:
    """Let a switch die and be forgotten; return its last link states."""
    origin = world.identities[label].name
    wires = [
        entry.wire for (its, _), entry in world.switches["nuc1"]._flooding.link_states._entries.items() if its == origin
    ]
    assert wires
    world.network.stop(label)
    world.network.run(LINK_STATE.lease_s + LINK_STATE.refresh_s + 1)
    return wires


def play(world: Simulation, wires: list[bytes], to: str = "nuc1") -> None:
    """Let the compromised neighbour of a switch replay link states."""
    for wire in wires:
        for frame in world.switches["nuc2"].state.outbox.fragmenter.split(Kind.LINK_STATE, wire, 1_500):
            world.network.inject(to, 0, frame, mac_of(world, to))
    world.network.run(1)


def origins(world: Simulation, label: str) -> set[bytes]:
    known_there = world.switches[label]._flooding.link_states
    return {bytes(each.origin) for scope in Scope for each in known_there.states(scope)}


@pytest.mark.momentary("nothing flows")
@pytest.mark.parametrize("later_s", [0.0, pytest.param(600.0, marks=pytest.mark.nightly)])
def test_a38_a_recorded_link_state_of_a_dead_switch_is_refused(later_s: float) -> None:
    world = ring(keepalive_ms=2_000)
    world.network.run(1)
    wires = buried(world, "nuc3")
    world.network.run(later_s)
    before = world.switches["nuc1"].drops()[DropReason.STALE]
    play(world, wires)
    dead = bytes(world.identities["nuc3"].name)
    assert not any(dead in origins(world, each) for each in ("nuc1", "nuc2", "nuc4", "nuc5"))
    assert world.switches["nuc1"].drops()[DropReason.STALE] == before + len(wires)


@pytest.mark.momentary("nothing flows")
def test_a38_a_switch_that_has_restarted_since_refuses_it_by_its_time() -> None:
    world = ring(keepalive_ms=2_000)
    world.network.run(1)
    wires = buried(world, "nuc3")
    restart_switch(world, "nuc1", LINK_STATE_AGE_MAX_S)  # much later
    world.network.run(2)
    play(world, wires)
    assert bytes(world.identities["nuc3"].name) not in origins(world, "nuc1")


def test_a38_numbers_of_the_dead_are_known_for_as_long_as_their_time_could_be_believed() -> None:
    states, incarnation_id = known(), b"1" * 16
    first = replace(state("a", link("b"), sequence=5), incarnation_id=incarnation_id)
    states.put(first, b"wire", 0.0)
    states.expire(LINK_STATE.lease_s)
    for now_s in (LINK_STATE.lease_s, LINK_STATE.lease_s + PAST_S - 1):
        states.expire(now_s)
        assert states.put(first, b"wire", now_s) is False
    assert states.put(replace(first, sequence=6), b"wire", LINK_STATE.lease_s + PAST_S - 1) is True
    states.expire(2 * LINK_STATE.lease_s + PAST_S)
    states.expire(2 * (LINK_STATE.lease_s + PAST_S))
    assert states._past == {}


def test_a38_a30_a_new_life_is_heard_below_the_numbers_of_the_last_and_that_stays_over() -> None:
    states = known()
    old = replace(state("a", link("b"), sequence=500), incarnation_id=b"1" * 16)
    states.put(old, b"wire", 0.0)
    states.expire(LINK_STATE.lease_s)
    assert states.put(replace(old, sequence=3, incarnation_id=b"2" * 16), b"wire", 200.0) is True
    assert states.put(old, b"wire", 201.0) is False
    for number in range(3, 20):  # an origin that draws incarnations to have its own forgotten
        states.put(replace(old, sequence=500 + number, incarnation_id=bytes([number]) * 16), b"wire", 202.0)
    states.expire(202.0 + LINK_STATE.lease_s)
    assert states.put(old, b"wire", 400.0) is False
    assert states.put(replace(old, incarnation_id=b"n" * 16, sequence=501), b"wire", 400.0) is False
