"""Enrolment of machines in tests: tickets, responder and listener, with a machine's side by hand."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from socket import socket as Socket  # noqa: N812 (``Desk.socket`` is the path)

from fog.bootstrap.bundles import machine_boot, machine_seats
from fog.bootstrap.listener import Listener, bind_unix
from fog.bootstrap.members import Authority
from fog.bootstrap.responder import Responder
from fog.bootstrap.tickets import Tickets
from fog.cluster import CloudNode, ClusterPlan, ExportedInterface, MachineRequest
from fog.hardware import Hardware
from fog.host.bundle import install
from fog.host.enrolment import enrol
from fog.machine import MachineBundle
from gdp.crypto.identity import NodeKeys
from gdp.stores.issue import make_domain, make_owner
from gdp.trust.bootstrap_ticket import (
    ANSWER_HEAD_BYTES,
    ANSWER_SECRET_BYTES,
    TOKEN_BYTES,
    Application,
    EnrolmentResponse,
    Ticket,
    apply,
    open_answer,
    seal_request,
)

PLAN = ExportedInterface("service", "/plan", "nav_msgs/srv/GetPlan", {"timeout_s": 9.0}, {"encoding": "cbor"})
MAP = ExportedInterface("topic", "/map", "nav_msgs/msg/OccupancyGrid")
CLUSTER = ClusterPlan(
    "c", (CloudNode("p", "e", environment={"X": "1"}),), (MachineRequest(Hardware(cpus=1)),), (PLAN, MAP)
)
DAY_S = 86_400.0


@dataclass
class Desk:
    """Launcher with tickets of its own."""

    folder: Path
    tickets: Tickets
    responder: Responder
    authority: Authority
    cluster: ClusterPlan = CLUSTER

    @property
    def socket(self) -> Path:
        return self.folder / "enrolment" / "socket"

    def ticket(self, name: str = "m7", *, address: str = "", minutes: float = 10.0, is_gateway: bool = False) -> Ticket:
        now_s = time.time()
        return self.tickets.issue(
            self.cluster.name,
            name,
            machine_seats(self.cluster, name, is_gateway=is_gateway),
            secrets.token_bytes(TOKEN_BYTES),
            addresses=[address or f"unix:{self.socket}"],
            unix_s=now_s,
            expires_unix_s=now_s + 60 * minutes,
            until_unix_s=now_s + DAY_S,
        )

    def boot(self, name: str = "m7", ticket: Ticket | None = None) -> MachineBundle:
        return machine_boot(
            self.authority,
            self.cluster,
            name,
            lambda node: ("run", node.package),
            ticket or self.ticket(name),
            iface="eth0",
        )

    @contextmanager
    def listening(self, listening: Socket | None = None) -> Iterator[Listener]:
        with closing(Listener(listening or bind_unix(self.socket), self.responder)) as made:
            yield made

    def enrol(self, home: Path, name: str = "m7", *, is_gateway: bool = False) -> None:
        """Act as a machine at its first start."""
        install(home, self.boot(name, self.ticket(name, is_gateway=is_gateway)))
        with self.listening():
            assert enrol(home)


@dataclass
class Machine:
    """Machine without a disk: keys for the seats of a ticket."""

    ticket: Ticket
    keys: list[NodeKeys] = field(default_factory=list)
    secret: bytes = field(default_factory=lambda: secrets.token_bytes(ANSWER_SECRET_BYTES))

    def __post_init__(self) -> None:
        self.keys = self.keys or [NodeKeys.generate(each.role, each.label) for each in self.ticket.seats]

    def applications(self) -> list[Application]:
        return [apply(self.ticket.token, each.key, each.request(), each.kem.public) for each in self.keys]

    def request(self, applications: Sequence[Application] | None = None) -> bytes:
        return seal_request(self.ticket, applications or self.applications(), self.secret)

    def opened(self, request: bytes, answer: bytes) -> EnrolmentResponse:
        return open_answer(self.ticket.token, request, self.secret, answer[ANSWER_HEAD_BYTES:])


@contextmanager
def made_desk(folder: Path, cluster: ClusterPlan = CLUSTER) -> Iterator[Desk]:
    make_domain(folder / "domain", "site")
    make_owner(folder / "owner")
    authority = Authority(folder / "domain", folder / "owner")
    with closing(Tickets(folder / "enrolment")) as tickets:
        yield Desk(folder, tickets, Responder(tickets, authority), authority, cluster)
