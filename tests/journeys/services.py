"""Servers and clients of one name in a simulation, and the results of their calls."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from math import ceil

from gdp.client.participant import Message, Participant
from gdp.client.publisher import Publisher
from gdp.names import Name
from gdp.trust.right import Right
from lab.simulation import Simulation
from tests.journeys.flows import LEASES, STEP_S

SERVICE = "/add_two_ints"


@dataclass(slots=True)
class Party:
    """Member that serves or calls a name: a server answers each request at once, with its content and its own label."""

    world: Simulation
    label: str
    right: Right
    name: str = SERVICE
    paths: int = 1
    is_session: bool = False
    stream: Publisher = field(init=False)
    service: Name = field(init=False)
    got: list[Message] = field(default_factory=list)
    answers: bool = True

    def __post_init__(self) -> None:
        self.begin()

    @property
    def member(self) -> Participant:
        """Return the member, in its present incarnation."""
        return self.world.members[self.label]

    def begin(self) -> None:
        """Serve or call from now on."""
        topic = self.world.topic(self.name, self.member, [self.right], kind="service")
        self.service = topic.name
        take_part = self.member.serve if self.right is Right.SERVE else self.member.call
        described = f"{self.right.value} by {self.label}".encode()
        self.stream = take_part(topic, described, paths=self.paths, is_session=self.is_session)
        self.world.network.send_pending(self.label)

    def publish(self, message: bytes) -> None:
        """Send a request to all servers, or news to all clients."""
        self.stream.publish(message)
        self._flush()

    def answer(self, client: Name, message: bytes) -> None:
        """Answer one client."""
        self.member.services.respond(self.service, client, message)
        self._flush()

    def collect(self) -> list[Message]:
        """Receive and answer new messages; return all received so far."""
        messages = self.member.poll_messages()
        self.got += messages
        if self.right is Right.SERVE and self.answers:
            for each in messages:
                if Name(each.delivered.publisher) in {
                    writer_proxy.publisher for writer_proxy in self.member.subscriptions.writer_proxies_of(self.service)
                }:
                    self.answer(Name(each.delivered.publisher), each.delivered.message + b" by " + self.label.encode())
        return self.got

    def bodies(self) -> list[bytes]:
        """Return the messages that have come."""
        return [each.delivered.message for each in self.collect()]

    def _flush(self) -> None:
        self.member.flush(self.world.network.now.mono_s)
        self.world.network.send_pending(self.label)


def outlive(world: Simulation, client: Party, *servers: Party, leases: float = LEASES) -> None:
    """Call at a steady rate until three leases are over; each server answers each request once, and in order."""
    client.collect()
    before, count = len(client.got), ceil(leases * world.lease_s / STEP_S)
    for server in servers:
        server.collect()  # earlier requests are not to be answered now
        server.answers = True
    asked = [b"outlives %d" % number for number in range(count)]
    for number, request in enumerate(asked):
        world.network.call(number * STEP_S, partial(client.publish, request))
    work(world, *servers, client, until_s=count * STEP_S)
    work(world, *servers, client, until_s=5.0, have=before + count * len(servers))
    bodies = [each.delivered.message for each in client.got[before:]]
    for server in servers:
        tail = b" by " + server.label.encode()
        assert [body for body in bodies if body.endswith(tail)] == [request + tail for request in asked]


def meet(world: Simulation, *parties: Party, within_s: float = 5.0) -> bool:
    """Advance time until every client has met every server; return whether that came true."""
    servers = sum(party.right is Right.SERVE for party in parties)
    clients = len(parties) - servers

    def have_met() -> bool:
        return all(
            len(party.member.services.peers(party.service)) == (clients if party.right is Right.SERVE else servers)
            for party in parties
        )

    return world.network.run(within_s, have_met)


def work(world: Simulation, *parties: Party, until_s: float, have: int = 0) -> bool:
    """Let servers answer for a while; return whether this many messages have come to the last party."""

    def is_done() -> bool:
        for party in parties:
            party.collect()
        return 0 < have <= len(parties[-1].got)

    return world.network.run(until_s, is_done)
