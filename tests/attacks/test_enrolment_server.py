"""Attacks on a domain's enrolment server: by removed machines, by members, and by what a crash leaves."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gdp.control.endpoints import Candidate, CandidateType, Endpoint
from gdp.crypto.cbor import Value, encode
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity, NodeKeys
from gdp.crypto.statements import parse
from gdp.enrolment import desk as desk_module
from gdp.enrolment import server as server_module
from gdp.enrolment.create import DomainPlan, create_domain, make_token
from gdp.enrolment.desk import EnrolmentDesk, MemberConnection
from gdp.enrolment.domain_files import DomainFiles
from gdp.enrolment.registry import Registry
from gdp.enrolment.removal import remove_machine
from gdp.errors import StoreError
from gdp.intervals import Rate
from gdp.links.endpoint_files import own_record
from gdp.stores.files import public, write_all
from gdp.stores.keyring import load_domain
from gdp.trust.enrolment_wire import MEMBERS, EnrolmentError, Message, Refusal, apply, prove_member
from gdp.trust.join_token import JoinRole, JoinToken, join_id, join_key, join_proof
from gdp.trust.mail import Mail
from gdp.trust.revocation import Revocation
from tests.gdp.enrolment.lab import running_lab

NOW = 1_800_000_000.0
DAY_S = 86_400.0
BINDING, NONCE, INSTANCE = bytes(32), bytes(32), bytes(16)


@dataclass(frozen=True)
class Server:
    """A domain and the desk of its enrolment server, without a socket."""

    files: DomainFiles
    registry: Registry
    desk: EnrolmentDesk

    def token(self) -> JoinToken:
        return make_token(self.files, JoinRole.ROBOT, valid_s=3_600.0, unix_s=NOW)

    def joined(self, label: str) -> Machine:
        machine = Machine.with_token(self.token(), label)
        machine.take(machine.ask(self.desk), self.files)
        return machine

    def remove(self, label: str) -> None:
        remove_machine(self.files, label, unix_s=NOW)

    def revoked(self) -> set[bytes]:
        found = (each.read_bytes() for each in self.files.config.revocations.glob("*.revoke"))
        return {Revocation.from_statement(parse(each)).fingerprint for each in found}


@dataclass
class Machine:
    """A machine that joins with a token: the switch first, then the proxy."""

    token: JoinToken
    label: str
    keys: Sequence[NodeKeys]
    identities: Sequence[Identity] = ()

    @classmethod
    def with_token(cls, token: JoinToken, label: str) -> Machine:
        return cls(token, label, [NodeKeys.generate(role, label) for _, role in token.role.nodes])

    def ask(self, desk: EnrolmentDesk) -> Message:
        made = [apply(join_id(self.token.secret), each.key, each.request(), each.kem.public) for each in self.keys]
        nodes: list[Any] = [each.to_fields() for each in made]
        untagged: dict[str, Value] = {"op": "join", "id": join_id(self.token.secret), "nodes": nodes}
        proof = join_proof(join_key(self.token.secret), BINDING, NONCE, encode(untagged))
        return desk.join({**untagged, "mac": proof}, BINDING, NONCE, NOW)

    def take(self, answer: Message, files: DomainFiles) -> None:
        root = load_domain(files.config.domain).root
        members = [Membership.from_wire(each, root, NOW) for each in MEMBERS.read(answer)]
        self.identities = [key.admitted(each, root) for key, each in zip(self.keys, members, strict=True)]

    def session(self, desk: EnrolmentDesk, unix_s: float = NOW, *, node: int = -1) -> MemberConnection:
        identity = self.identities[node]
        proof = prove_member(identity.key, BINDING, NONCE, INSTANCE)
        fields: Message = {"certificate": identity.membership, "signature": proof, "instance": INSTANCE}
        return desk.identify(fields, BINDING, NONCE, unix_s)

    def renewal(self) -> Message:
        certificates: list[Value] = [each.membership for each in self.identities]
        return {"certificates": certificates}

    def record(self, candidates: Sequence[Candidate] = ()) -> Message:
        return {"cards": list[Value](), "record": own_record(self.identities[0], 1, candidates).wire}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    plan = DomainPlan(
        name="lab",
        directory=tmp_path / "lab",
        public=[Endpoint("192.0.2.1", 51_820)],
        servers=["192.0.2.1:4780"],
        listen=4_780,
    )
    files = create_domain(plan, unix_s=NOW)
    with Registry(files.config.state) as registry:
        yield Server(files, registry, EnrolmentDesk(files, registry))


# removed machines


def test_a77_a_machine_that_was_removed_before_it_had_joined_gets_no_memberships(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine.with_token(server.token(), "mallory")

    def fail(*args: object) -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(Registry, "complete_token", fail)
        with pytest.raises(StoreError):
            machine.ask(server.desk)
    server.remove("mallory")
    with pytest.raises(EnrolmentError, match="was removed from the domain") as refusal:
        machine.ask(server.desk)
    assert refusal.value.code is Refusal.NO_MEMBER


def test_a77_a_machine_that_is_removed_while_it_joins_gets_no_memberships(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine.with_token(server.token(), "mallory")
    complete = Registry.complete_token

    def removed_before(
        registry: Registry, identifier: bytes, number: int, members: Sequence[Membership], answer: bytes
    ) -> None:
        server.remove("mallory")
        complete(registry, identifier, number, members, answer)

    monkeypatch.setattr(Registry, "complete_token", removed_before)
    with pytest.raises(EnrolmentError, match="was removed from the domain"):
        machine.ask(server.desk)


def test_a77_a_machine_that_is_removed_while_it_renews_gets_no_membership(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = server.joined("mallory")
    session = machine.session(server.desk)
    renewed = Registry.renewed

    def removed_before(registry: Registry, members: Sequence[Membership]) -> None:
        server.remove("mallory")
        renewed(registry, members)

    monkeypatch.setattr(Registry, "renewed", removed_before)
    with pytest.raises(EnrolmentError, match="was removed from the domain"):
        server.desk.renew(session, machine.renewal(), NOW + 20 * DAY_S)


def test_a77_the_token_of_a_removed_machine_gives_its_memberships_no_second_time(server: Server) -> None:
    machine = server.joined("mallory")
    server.remove("mallory")
    assert {each.member.fingerprint for each in machine.identities} <= server.revoked()
    with pytest.raises(EnrolmentError, match="was removed from the domain"):
        machine.ask(server.desk)


def test_a78_the_record_of_a_machine_that_is_removed_meanwhile_does_not_stay_with_the_border(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = server.joined("mallory")
    session = machine.session(server.desk)

    def removed_before(*args: object, **kwargs: object) -> None:
        server.remove("mallory")
        write_all(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(desk_module, "write_all", removed_before)
    with pytest.raises(EnrolmentError, match="was removed from the domain"):
        server.desk.install(session, machine.record(), NOW)
    assert not list(server.files.config.peers.glob("*.endpoints"))


@pytest.mark.parametrize("folder", ["switch", "proxy"])
def test_a79_a_revoked_membership_is_not_renewed(server: Server, folder: str) -> None:
    """``gdp cert revoke`` takes one membership back, and not the machine."""
    machine = server.joined("mallory")
    session = machine.session(server.desk)
    revoked = machine.identities[("switch", "proxy").index(folder)].member
    authority = load_domain(server.files.config.domain)
    wire = Revocation.make(authority.key, authority.root.signer, revoked.fingerprint, revoked.not_after_unix_s)
    write_all(server.files.config.revocations, {"by-hand.revoke": public(wire)})
    with pytest.raises(EnrolmentError, match="was revoked") as refusal:
        server.desk.renew(session, machine.renewal(), NOW + 20 * DAY_S)
    assert refusal.value.code is Refusal.NO_MEMBER


def test_a79_a_membership_that_followed_a_revoked_one_is_not_renewed(server: Server) -> None:
    machine = server.joined("mallory")
    first = machine.identities[0].member
    session = machine.session(server.desk)
    server.desk.renew(session, machine.renewal(), NOW + 20 * DAY_S)
    authority = load_domain(server.files.config.domain)
    wire = Revocation.make(authority.key, authority.root.signer, first.fingerprint, first.not_after_unix_s)
    write_all(server.files.config.revocations, {"by-hand.revoke": public(wire)})
    with pytest.raises(EnrolmentError, match="was revoked"):
        server.desk.renew(session, machine.renewal(), NOW + 28 * DAY_S)


# crashes


def test_a_server_that_died_while_a_machine_joined_completes_the_repeated_request(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine.with_token(server.token(), "robot")

    def die(*args: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Registry, "complete_token", die)
        with pytest.raises(KeyboardInterrupt):
            machine.ask(server.desk)
    with Registry(server.files.config.state) as registry:
        machine.take(machine.ask(EnrolmentDesk(server.files, registry)), server.files)
        with pytest.raises(EnrolmentError, match="used already by 'robot'"):
            Machine.with_token(machine.token, "thief").ask(EnrolmentDesk(server.files, registry))


def test_a_machine_that_died_while_it_joined_is_removed_and_joins_again(server: Server) -> None:
    lost = Machine.with_token(server.token(), "robot")
    lost.ask(server.desk)
    with pytest.raises(EnrolmentError, match="remove that machine first"):
        server.joined("robot")
    server.remove("robot")
    server.joined("robot")


# strangers


def test_a83_the_connections_of_one_address_leave_handshakes_for_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "CONNECTIONS_RATE", Rate(2.0, burst=2.0))
    monkeypatch.setattr(server_module, "ADDRESS_CONNECTIONS_RATE", Rate(1.0, burst=4.0))
    with running_lab(tmp_path) as lab, contextlib.ExitStack() as strangers:
        for _ in range(100):
            made = socket.create_connection(("127.0.0.1", lab.port), source_address=("127.0.0.2", 0))
            strangers.enter_context(made)
        lab.join("patient")


# members


@pytest.mark.parametrize("type_", list(CandidateType))
def test_a80_a_member_has_its_border_send_to_no_address_of_its_choice(server: Server, type_: CandidateType) -> None:
    machine = server.joined("mallory")
    victim = Candidate(0, type_, Endpoint("198.51.100.7", 53))
    with pytest.raises(EnrolmentError, match="states no endpoints") as refusal:
        server.desk.install(machine.session(server.desk), machine.record([victim]), NOW)
    assert refusal.value.code is Refusal.WRONG_NODES
    assert not list(server.files.config.peers.glob("*.endpoints"))


def test_a81_one_members_mail_leaves_space_in_a_mailbox_for_others(server: Server) -> None:
    victim, mallory, owner = (server.joined(label) for label in ("victim", "mallory", "owner"))
    to = victim.identities[-1].name

    def send(machine: Machine, node: int, count: int) -> None:
        wire = Mail.make(machine.identities[node], to, "delegation", bytes(12 << 10), NOW)
        session = machine.session(server.desk, node=node)
        for _ in range(count):
            server.desk.send(session, {"mail": wire}, NOW)

    for node in (0, 1):  # as its switch, and as its proxy
        with pytest.raises(EnrolmentError) as refusal:
            send(mallory, node, 1_024)
        assert refusal.value.code is Refusal.MAILBOX_FULL
    send(owner, 1, 64)
