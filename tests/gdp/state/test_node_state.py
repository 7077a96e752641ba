"""State of a node: what is measured of its neighbours, and its links for ``gdp status`` and metrics."""

from __future__ import annotations

from gdp.names import Name
from gdp.state.control_status import link_status
from gdp.telemetry.sources import NeighbourRow
from lab.simulation import Simulation
from lab.topology import DomainPlan, Link, Topology
from tests.gdp.state.memory_states import switch_state

PAIR = Topology((Link("one", "two"),), (DomainPlan("lab", ("one", "two")),), ())


def paired() -> Simulation:
    """Return two switches that are neighbours."""
    world = Simulation(topology=PAIR)
    assert world.network.run(
        5, lambda: all(each.hello_protocol.neighbours.all_up() for each in world.switches.values())
    )
    world.network.run(3)
    return world


def test_a_link_shows_what_was_measured_of_a_neighbour() -> None:
    world = paired()
    state = switch_state(world, "one")
    state.refresh(world.network.now)
    (row,) = state.links
    shown = link_status(row)
    assert (shown["port"], shown["neighbour"], shown["cost"]) == ("to-two", world.switches["two"].name.short, 10)
    assert (shown["loss_in"], shown["loss_out"]) == (0.0, 0.0)
    assert isinstance(shown["rtt_ms"], float)


def test_a_neighbour_that_is_lost_has_no_link() -> None:
    world = paired()
    world.network.set_link(world.cables[frozenset(("one", "two"))], up=False)
    state = switch_state(world, "one")
    state.refresh(world.network.now)
    assert state.links == []


def test_a_link_that_is_not_measured_has_no_round_trip_time() -> None:
    shown = link_status(NeighbourRow(port="wg0", name=Name(bytes(32)), cost=100))
    assert (shown["rtt_ms"], shown["rtt_var_ms"], shown["cost"]) == (None, None, 100)


def test_drops_of_plane_and_core_are_added() -> None:
    state = switch_state(paired(), "one")
    core = dict(state.core.drops())
    assert sum(state.drops().values()) == 2 + sum(core.values())


def test_a_port_has_the_counts_of_its_device_and_an_absent_one_has_none() -> None:
    state = switch_state(paired(), "one")
    assert [each.counts for each in state.ports()] == [None]
    state.read_devices = lambda: {"to-two": tuple(range(8))}
    (port,) = state.ports()
    assert (port.port, port.is_up, port.mtu) == ("to-two", True, 1_500)
    assert port.counts is not None
    assert (port.counts.frames_in, port.counts.bytes_in, port.counts.drops_out) == (0, 2, 7)
