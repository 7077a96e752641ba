"""States of simulated nodes: each over its core and a plane that has the ports of the network in memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

from gdp.ports.plane import Counters, Plane, Port
from gdp.state.node_state import MemberState, RibState, SwitchState
from lab.simulation import Simulation

__all__ = ["MemoryPlane", "member_state", "plane_of", "rib_state", "switch_state"]


class MemoryPlane:
    """Plane of a simulated node: its ports, and counts that tests set."""

    def __init__(self, ports: Mapping[int, Port]) -> None:
        self.ports = ports
        self.counters = Counters(frames_in=120, frames_out=110, forwarded=90, punted=30)
        self.counters.drops[3] = 2


def plane_of(world: Simulation, node: str) -> Plane:
    """Return a plane with the ports of a node; each has the name of the node at its other end."""
    ports = world.network._nodes[node].ports
    return cast(
        Plane,
        MemoryPlane(
            {
                index: Port(index, f"to-{far.node.replace('/', '-')}", own.mac, link.mtu, up=True)
                for index, (link, own, far) in ports.items()
            }
        ),
    )


def switch_state(world: Simulation, label: str, *, begun_s: float | None = None) -> SwitchState:
    """Return the state of a switch; ``begun_s``: monotonic second of its start, by default now."""
    switch, begun_s = world.switches[label], world.network.now.mono_s if begun_s is None else begun_s
    return SwitchState(world.identities[label], switch.state.policy, plane_of(world, label), switch, begun_s)


def rib_state(world: Simulation, label: str) -> RibState:
    """Return the state of a RIB, by its label in ``world.ribs``."""
    host, plane, now_s = world.ribs[label], plane_of(world, world.rib_node(label)), world.network.now.mono_s
    return RibState(world.identities[f"rib:{label}"], host.rib.state.policy, plane, host, now_s)


def member_state(world: Simulation, label: str) -> MemberState:
    """Return the state of a member."""
    member, plane = world.members[label], plane_of(world, label)
    return MemberState(world.identities[label], member.attachment._policy, plane, member, world.network.now.mono_s)
