"""Stage of the insiders: a simulated network in which some members of every kind are hostile.

::

    school:    nuc1 ---- nuc2        at both: evil (hostile switch, with a hostile RIB), hired (hostile leaf)
    backbone:          nuc3          upper RIB
    cloud:             nuc4          far (hostile switch) at nuc3 and nuc4; hostile RIB at far
    stranger:          x1 at nuc2    no domain of the others trusts it

The good flow goes from nuc1/robot to nuc4/server; no insider has a right on its topic, and none is on its path.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from gdp.client.participant import Participant, Topic
from gdp.client.rib_host import RibHost
from gdp.control.hello import ECHO_BYTES
from gdp.control.hello_port import HelloPort
from gdp.crypto.identity import Identity
from gdp.switch.core import SwitchCore
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.journeys.flows import Flow

__all__ = ["GOOD", "PARTS", "PERSONAS", "PROMISE_S", "Persona", "Place", "Stage"]

PROMISE_S: Final = 3.0  # within which a message of an established flow arrives
GOOD: Final = ("nuc1/robot", "nuc4/server")
_TRUSTED: Final = ("school", "backbone", "cloud")
_LEASE_S: Final = 6.0
_TOPIC, _SERVICE = "/noise", "/work"
PARTS: Final = {
    "nuc1/insider": ((_TOPIC, Right.PUBLISH), (_SERVICE, Right.SERVE)),
    "nuc2/reader": ((_TOPIC, Right.READ),),
    "nuc4/alien": ((_TOPIC, Right.READ), (_SERVICE, Right.CALL)),
    "evil/guest": ((_TOPIC, Right.READ), (_SERVICE, Right.SERVE)),
    "hired/tenant": ((_TOPIC, Right.READ), (_SERVICE, Right.SERVE)),
}

_TOPOLOGY: Final = Topology(
    links=(
        Link("nuc1", "nuc2"),
        Link("nuc2", "nuc3"),
        Link("nuc3", "nuc4"),
        Link("evil", "nuc1"),
        Link("evil", "nuc2"),
        Link("hired", "nuc1"),
        Link("hired", "nuc2"),
        Link("far", "nuc3"),
        Link("far", "nuc4"),
        Link("x1", "nuc2"),
    ),
    domains=(
        DomainPlan("school", ("nuc1", "nuc2", "evil", "hired"), upper="backbone"),
        DomainPlan("backbone", ("nuc3",)),
        DomainPlan("cloud", ("nuc4", "far"), upper="backbone"),
        DomainPlan("stranger", ("x1",)),
    ),
    attachments=(
        Attachment("nuc2", "rib", "rib"),
        Attachment("evil", "rib", "rib2"),
        Attachment("nuc3", "rib", "rib"),
        Attachment("nuc4", "rib", "rib"),
        Attachment("far", "rib", "rib2"),
        Attachment("x1", "rib", "rib"),
        Attachment("nuc1", "proxy", "robot"),
        Attachment("nuc4", "proxy", "server"),
        Attachment("nuc1", "proxy", "insider"),
        Attachment("nuc2", "proxy", "outcast"),
        Attachment("nuc4", "proxy", "alien"),
        Attachment("nuc2", "proxy", "reader"),
        Attachment("evil", "proxy", "guest"),
        Attachment("hired", "proxy", "tenant"),
        Attachment("x1", "proxy", "mallory"),
    ),
)


@dataclass(frozen=True, slots=True)
class Persona:
    """Hostile member.

    Args:
        node: its name in the network.
        identity: label in ``Simulation.identities``.
        may_break: whether its role lets it hurt the good flow: RIBs of the flow's domains answer where names are.
    """

    node: str
    identity: str
    may_break: bool = False


PERSONAS: Final = (
    Persona("nuc1/insider", "nuc1/insider"),  # publishes the topic, serves the service
    Persona("nuc2/reader", "nuc2/reader"),
    Persona("nuc4/alien", "nuc4/alien"),  # reads and calls, of another trusted domain
    Persona("nuc2/outcast", "nuc2/outcast"),  # its membership is revoked
    Persona("x1/mallory", "x1/mallory"),
    Persona("evil", "evil"),
    Persona("far", "far"),
    Persona("hired", "hired"),  # a leaf, as on a rented machine
    Persona("hired/tenant", "hired/tenant"),  # and a proxy behind it
    Persona("x1", "x1"),
    Persona("evil/rib2", "rib:school#2", may_break=True),
    Persona("far/rib2", "rib:cloud#2", may_break=True),
    Persona("nuc3/rib", "rib:backbone", may_break=True),
)


@dataclass(frozen=True, slots=True)
class Place:
    """Port of a node, and the address of its neighbour there."""

    node: str
    port: int
    mac: bytes


@dataclass(slots=True)
class Stage:
    """Settled network: topics flow, a service works, one member is revoked.

    Attributes:
        flow: the good one.
        topics: what the insiders may do with their topic and their service, by label and right.
    """

    seed: int
    world: Simulation = field(init=False)
    flow: Flow = field(init=False)
    topics: dict[str, Topic] = field(default_factory=dict)
    _rib_nodes: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.world = world = Simulation(
            topology=_TOPOLOGY,
            seed=self.seed,
            hello_s=1.0,
            dead_s=3.6,
            lease_s=_LEASE_S,
            keepalive_ms=1_000,
            leaves=("hired",),
            trusts=dict.fromkeys(_TRUSTED, _TRUSTED) | {"stranger": ("stranger", *_TRUSTED)},
        )
        self._rib_nodes = {label: world.rib_node(label) for label in world.ribs}
        world.run_until_attached(8.0)
        source, sink = GOOD
        topic = world.topic("/good", world.members[source], [Right.PUBLISH])
        publisher = world.members[source].advertise(topic, b"described", reliable=True)
        world.network.send_pending(source)
        self.flow = Flow(world, "/good", source, topic, publisher)
        self.flow.read_by(sink)
        self.join_in()
        world.network.run(3.0)
        self.revoke("nuc2/outcast")
        world.network.run(2.0)

    def join_in(self) -> None:
        """Let the insiders' members publish, read, serve and call."""
        for label in PARTS:
            self.take_part_again(label)

    def take_part_again(self, label: str) -> None:
        """Give a member its role, unless it has it already."""
        member = self.world.members[label]
        pending_advertisement = {each.right for each in member.attachment.advertisements}
        for name, right in PARTS.get(label, ()):
            if right in pending_advertisement:
                continue
            topic = self.topics.get(f"{label} {right.value}") or self.world.topic(name, member, [right])
            self.topics[f"{label} {right.value}"] = topic
            if right is Right.PUBLISH:
                member.advertise(topic, b"described", reliable=True)
            elif right is Right.READ:
                member.subscribe(topic)
            elif right is Right.SERVE:
                member.serve(topic, b"served")
            else:
                member.call(topic, b"called")
        self.world.network.send_pending(label)

    def publish(self, message: bytes) -> None:
        """Let the insiders' publisher publish, and their server answer its clients."""
        member = self.world.members["nuc1/insider"]
        for publisher in list(member.publications):
            publisher.publish(message)
        service = self.topics["nuc1/insider serve"].name
        for client in member.services.connected_peers(service):
            member.services.respond(service, client, message)
        member.flush(self.world.network.now.mono_s)
        self.world.network.send_pending("nuc1/insider")

    def revoke(self, label: str) -> None:
        """Let nuc1's operator revoke a member's membership."""
        world = self.world
        member = world.identities[label].member
        authority = world.authorities["school"]
        wire = Revocation.make(
            authority.key, authority.root.subject, member.fingerprint, member.validity.not_after_unix_s
        )
        world.switches["nuc1"].revoke(wire, world.network.now)
        world.network.send_pending("nuc1")

    def identity(self, persona: Persona) -> Identity:
        """Return a persona's keys and membership."""
        return self.world.identities[persona.identity]

    def places(self, node: str) -> list[Place]:
        """Return the ingress of a node's frames: a port of each of its neighbours."""
        ports = self.world.network._nodes[node].ports.values()
        return [Place(far.node, far.port, own.mac) for sim_link, own, far in ports if sim_link.is_up]

    def machines(self) -> dict[str, SwitchCore | RibHost | Participant]:
        """Return every machine that is alive, by node."""
        world = self.world
        ribs = {self._rib_nodes[label]: host for label, host in world.ribs.items()}
        machines: dict[str, SwitchCore | RibHost | Participant] = {**world.switches, **ribs, **world.members}
        return {node: each for node, each in machines.items() if world.network._nodes[node].is_alive}

    def nonce_at(self, place: Place) -> bytes:
        """Return the nonce that a port sends in its hellos."""
        port = self._port_at(place)
        return bytes(8) if port is None else port.nonce

    def echo_at(self, place: Place) -> bytes:
        """Return the reference to a port's session that others use."""
        port = self._port_at(place)
        return bytes(ECHO_BYTES) if port is None else port.echo

    def own_nonce(self, persona: Persona, place: Place) -> bytes:
        """Return the nonce of the persona's own port that leads to a location."""
        ports = self.world.network._nodes[persona.node].ports
        index = next((i for i, (_, _, far) in ports.items() if (far.node, far.port) == (place.node, place.port)), -1)
        port = self._port_at(Place(persona.node, index, b""))
        return bytes(8) if port is None else port.nonce

    def believes(self, persona: Persona, place: Place) -> bool:
        """Return whether a node accepts a persona: its domain is trusted there, and it is not revoked."""
        domain = self.identity(persona).root.domain
        machine = self.machines().get(place.node)
        policy: Policy | None = None
        if machine is not None:
            policy = machine.state.policy if isinstance(machine, SwitchCore) else machine.attachment._policy
        is_revoked = persona.node == "nuc2/outcast"
        return policy is not None and policy.trusts(domain) and not is_revoked

    def _port_at(self, place: Place) -> HelloPort | None:
        machine = self.machines().get(place.node)
        if machine is None:
            return None
        hello_protocol = (
            machine.hello_protocol if isinstance(machine, SwitchCore) else machine.attachment.hello_protocol
        )
        return hello_protocol.ports.get(place.port)
