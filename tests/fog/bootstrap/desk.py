"""Joining of a cluster's machines in tests: a site's enrolment server, with a machine's side by hand."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fog.bootstrap.bundles import machine_boot, machine_label
from fog.bootstrap.domain_members import DomainMembers
from fog.bootstrap.members import Authority
from fog.cluster import CloudNode, ClusterPlan, ExportedInterface, MachineRequest
from fog.hardware import Hardware
from fog.host.bundle import install
from fog.host.joining import join
from fog.machine import MachineBundle
from fog.site import Site, open_site
from gdp.crypto.cbor import Value, encode
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import NodeKeys
from gdp.enrolment.desk import EnrolmentDesk
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.registry import Registry
from gdp.enrolment.server import bind_unix, serve_domain_in_thread
from gdp.stores.keyring import load_domain
from gdp.trust.enrolment_wire import MEMBERS, Application, Message, apply
from gdp.trust.join_token import JoinToken, join_id, join_key, join_proof

PLAN = ExportedInterface("service", "/plan", "nav_msgs/srv/GetPlan", {"timeout_s": 9.0}, {"encoding": "cbor"})
MAP = ExportedInterface("topic", "/map", "nav_msgs/msg/OccupancyGrid")
CLUSTER = ClusterPlan(
    "c", (CloudNode("p", "e", environment={"X": "1"}),), (MachineRequest(Hardware(cpus=1)),), (PLAN, MAP)
)
DAY_S = 86_400.0
BINDING, NONCE = bytes(32), bytes(32)


@dataclass
class Desk:
    """Launcher with tokens of its own; ``desk`` decides without a socket."""

    site: Site
    files: DomainFiles
    registry: Registry
    members: DomainMembers
    desk: EnrolmentDesk
    cluster: ClusterPlan = CLUSTER

    @property
    def authority(self) -> Authority:
        return self.site.authority

    def token(self, name: str = "m7", *, minutes: float = 10.0, is_gateway: bool = False) -> JoinToken:
        now_s = time.time()
        return self.members.issue_token(
            machine_label(self.cluster.name, name),
            self.cluster.carried,
            is_gateway=is_gateway,
            valid_s=60 * minutes,
            until_unix_s=now_s + DAY_S,
            unix_s=now_s,
        )

    def boot(self, name: str = "m7", token: JoinToken | None = None) -> MachineBundle:
        token = token or self.token(name)
        return machine_boot(self.cluster, name, lambda node: ("run", node.package), token, iface="eth0")

    @contextmanager
    def listening(self) -> Iterator[None]:
        with serve_domain_in_thread(self.files, bind_unix(self.site.enrolment_socket, socket.SOCK_STREAM)):
            yield

    def join(self, home: Path, name: str = "m7", *, is_gateway: bool = False) -> None:
        """Act as a machine at its first start."""
        install(home, self.boot(name, self.token(name, is_gateway=is_gateway)))
        with self.listening():
            assert join(home)

    def restarted(self) -> EnrolmentDesk:
        """Return the desk of a server that was killed and started again."""
        return EnrolmentDesk(self.files, self.registry)


@dataclass
class Machine:
    """Machine without a disk: keys for the nodes of a token's role."""

    token: JoinToken
    label: str = "c-m7"
    keys: list[NodeKeys] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.keys = self.keys or [NodeKeys.generate(role, self.label) for _, role in self.token.role.nodes]

    @property
    def identifier(self) -> bytes:
        return join_id(self.token.secret)

    def applications(self) -> list[Application]:
        return [apply(self.identifier, each.key, each.request(), each.kem.public) for each in self.keys]

    def request(
        self, applications: Sequence[Application] | None = None, binding: bytes = BINDING, nonce: bytes = NONCE
    ) -> dict[str, Value]:
        nodes: list[Any] = [each.to_fields() for each in applications or self.applications()]
        untagged: dict[str, Value] = {"op": "join", "id": self.identifier, "nodes": nodes}
        return {**untagged, "mac": join_proof(join_key(self.token.secret), binding, nonce, encode(untagged))}

    def ask(
        self, desk: EnrolmentDesk, applications: Sequence[Application] | None = None, *, at_s: float | None = None
    ) -> Message:
        """Return the response of a desk; a refusal raises ``EnrolmentError``."""
        return desk.join(self.request(applications), BINDING, NONCE, time.time() if at_s is None else at_s)


def memberships(desk: Desk, answer: Message) -> list[Membership]:
    """Return the memberships in a response, which are verified."""
    root = load_domain(desk.authority.domain).root
    return [Membership.from_wire(each, root, time.time()) for each in MEMBERS.read(answer)]


@contextmanager
def made_desk(folder: Path, cluster: ClusterPlan = CLUSTER) -> Iterator[Desk]:
    with desk_of(open_site(None, folder / "site"), cluster) as made:
        yield made


@contextmanager
def desk_of(site: Site, cluster: ClusterPlan = CLUSTER) -> Iterator[Desk]:
    files = site.domain_files
    with closing(DomainMembers(files)) as members, Registry(files.config.state) as registry:
        yield Desk(site, files, registry, members, EnrolmentDesk(files, registry), cluster)
