"""One-time enrolment of machines: content of user data, and limits of a token."""

from __future__ import annotations

import base64
import gzip
import os
import secrets
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from fog.bootstrap.bundles import joining_boot
from fog.bootstrap.listener import CONNECTION_S, CONNECTIONS_MAX, Listener, bind_tcp
from fog.bootstrap.responder import OPENED_MAX, Responder
from fog.bootstrap.tickets import Report, Tickets
from fog.host.bundle import JOIN_FILE, TICKET_FILE, install, pack
from fog.host.enrolment import enrol
from fog.machine import MachineBundle, MachineSpec
from fog.providers.aws.provider import AwsProvider
from fog.providers.cloud_init import Setup, placed, shell_script, user_data
from fog.site import Site
from fog.supervisor.journal import Journal
from gdp.crypto.certificates import Membership, Role, Root
from gdp.crypto.identity import NodeKeys
from gdp.crypto.kem import KemPrivateKey
from gdp.crypto.keys import PublicKey, SigningKey, SoftwareKey
from gdp.errors import LocalError, StatementError
from gdp.stores.audit_log import verify_audit
from gdp.stores.keyring import load_domain, load_owner
from gdp.trust.bootstrap_ticket import (
    HEAD_BYTES,
    REFUSED,
    REQUEST_MAX_BYTES,
    Ticket,
    answer_bytes,
    apply,
    open_answer,
    open_request,
    seal_answer,
)
from gdp.trust.join_token import JOIN_SECRET_BYTES, JoinRole, JoinToken
from tests.fog.bootstrap.desk import CLUSTER, Desk, Machine, made_desk
from tests.fog.providers.test_aws import Cloud, aws, cloud, spec
from tests.fog.supervisor.test_supervisor import PLAN, Memory, journal, site, supervisor, work

__all__ = ["aws", "cloud", "journal", "site"]


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    with made_desk(tmp_path) as made:
        yield made


def asked(desk: Desk, request: bytes, *, at_s: float | None = None) -> bytes:
    return desk.responder.answer(request, time.time() if at_s is None else at_s)


def members(desk: Desk, machine: Machine, request: bytes, answer: bytes) -> list[Membership]:
    opened = machine.opened(request, answer)
    root = Root.from_wire(opened.root)
    assert root == load_domain(desk.authority.domain).root
    return [Membership.from_wire(each.member, root, time.time()) for each in opened.granted]


def reports(tickets: Tickets) -> list[Report]:
    return [each.report for each in tickets.pending_reports()]


# content of user data


def launchers_secrets(desk: Desk) -> list[bytes]:
    """Return every private key that the launcher has, in each form in which it might be written."""
    owner, domain = load_owner(desk.authority.owner), load_domain(desk.authority.domain)
    found = [owner.master, desk.tickets.responder.wire]
    for key in (owner.key, domain.key):
        numbers = key.private.private_numbers()  # type: ignore[attr-defined]
        found += [numbers.private_value.to_bytes(32, "big"), key.to_pem()]  # type: ignore[attr-defined]
    return [form for each in found for form in (each, each.hex().encode(), base64.b64encode(each))]


def rented() -> MachineBundle:
    """Return the bundle of a rented machine."""
    token = JoinToken(
        root=bytes(32),
        secret=secrets.token_bytes(JOIN_SECRET_BYTES),
        role=JoinRole.ROBOT,
        expires_unix_s=int(time.time()) + 900,
        servers=("198.51.100.7:51820",),
    )
    return joining_boot(CLUSTER, "m7", lambda node: ("run", node.package), token)


@pytest.mark.parametrize("provider", ["aws", "skypilot", "local"])
def test_a52_no_provider_tells_a_machine_a_private_key(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, provider: str
) -> None:
    drawn: list[str] = []
    generate, generate_kem = SigningKey.generate, KemPrivateKey.generate

    def counted() -> SoftwareKey:
        drawn.append("key")
        return generate()

    def counted_kem() -> KemPrivateKey:
        drawn.append("kem")
        return generate_kem()

    monkeypatch.setattr(SigningKey, "generate", staticmethod(counted))
    monkeypatch.setattr(KemPrivateKey, "generate", staticmethod(counted_kem))
    boot = desk.boot() if provider == "local" else rented()
    if provider == "local":
        install(tmp_path / "home", boot)
        reported = b"\n".join(path.read_bytes() for path in (tmp_path / "home").rglob("*") if path.is_file())
    elif provider == "aws":
        reported = gzip.decompress(user_data(pack(boot), Setup()))
    else:
        reported = shell_script(pack(boot), Setup()).encode()
        reported += b"\n".join(file.content for file in placed(pack(boot), Setup()))
    assert drawn == []
    assert b"PRIVATE KEY" not in reported
    assert b"GDP SECRET" not in reported
    assert not [path for path in boot.files if path.endswith((".key", ".delegation", ".csr", ".crt"))]
    assert not [each for each in launchers_secrets(desk) if each in reported]


def test_a52_ec2_receives_no_private_key(desk: Desk, cloud: Cloud, aws: AwsProvider) -> None:
    reported = cloud.user_data(aws.create(spec("enrolled"), rented()))
    paths = [each["path"] for each in reported["write_files"]]
    assert f"/var/lib/fog/{JOIN_FILE}" in paths
    assert not [path for path in paths if path.endswith(".key")]
    contents = [
        base64.b64decode(each["content"]) if "encoding" in each else each["content"].encode()
        for each in reported["write_files"]
    ]
    assert not [each for each in contents if b"PRIVATE KEY" in each]
    assert not [each for each in launchers_secrets(desk) if any(each in content for content in contents)]


def test_a52_an_enrolled_machine_keeps_no_token(desk: Desk, tmp_path: Path) -> None:
    ticket = desk.ticket()
    install(tmp_path / "home", desk.boot(ticket=ticket))
    with desk.listening():
        enrol(tmp_path / "home")
    left = b"\n".join(path.read_bytes() for path in (tmp_path / "home").rglob("*") if path.is_file())
    assert ticket.token not in left
    assert ticket.token.hex().encode() not in left
    assert all(path.stat().st_mode & 0o077 == 0 for path in (tmp_path / "home").rglob("*.key"))


# once


def test_a52_a_token_admits_one_machine_as_it_was_planned(desk: Desk) -> None:
    machine = Machine(desk.ticket())
    request = machine.request()
    got = members(desk, machine, request, asked(desk, request))
    assert [(each.role, each.label) for each in got] == [(Role.LEAF, "c-m7"), (Role.PROXY, "c-m7")]
    assert all(each.not_after_unix_s <= time.time() + 86_401 for each in got)
    (news,) = desk.tickets.pending_reports()
    assert news.report is Report.ENROLLED
    assert news.issued_credentials is not None
    assert news.issued_credentials.fingerprints == tuple(each.fingerprint.hex() for each in got)
    assert verify_audit(desk.authority.domain).events["accepted", "membership leaf"] == 1


def test_a52_who_uses_a_token_after_the_machine_gets_nothing_and_is_reported(desk: Desk) -> None:
    machine = Machine(desk.ticket())
    asked(desk, machine.request())
    (enrolled,) = desk.tickets.pending_reports()
    thief = Machine(machine.ticket)
    assert asked(desk, thief.request()) == REFUSED
    misused = desk.tickets.pending_reports()[-1]
    assert misused.report is Report.MISUSED
    assert misused.issued_credentials == enrolled.issued_credentials
    assert enrolled.issued_credentials is not None
    assert enrolled.issued_credentials.proxy[:16] in misused.detail
    assert asked(desk, thief.request()) == asked(desk, machine.request()) == REFUSED
    assert reports(desk.tickets) == [Report.ENROLLED, Report.MISUSED]  # once
    desk.responder.flush()
    assert verify_audit(desk.authority.domain).events["refused", "enrolment"] == 3


def test_a52_a_machine_that_comes_after_a_thief_is_the_alarm(desk: Desk, tmp_path: Path) -> None:
    ticket = desk.ticket()
    install(tmp_path / "home", desk.boot(ticket=ticket))
    asked(desk, Machine(ticket).request())
    with desk.listening(), pytest.raises(LocalError, match="refuses this machine's ticket"):
        enrol(tmp_path / "home")
    assert reports(desk.tickets) == [Report.ENROLLED, Report.MISUSED]


def test_a52_a_lost_answer_is_given_again_to_the_same_request_byte_for_byte(desk: Desk) -> None:
    machine = Machine(desk.ticket())
    request = machine.request()
    first = asked(desk, request)
    assert asked(desk, request) == first
    after_restart = Responder(desk.tickets, desk.authority)
    assert after_restart.answer(request, time.time()) == first
    assert reports(desk.tickets) == [Report.ENROLLED]


def test_a52_a_machine_that_starts_again_gets_the_same_memberships(desk: Desk) -> None:
    machine = Machine(desk.ticket())
    request = machine.request()
    first = members(desk, machine, request, asked(desk, request))
    again = replace(machine, secret=secrets.token_bytes(32))
    request = again.request()
    assert members(desk, again, request, asked(desk, request)) == first
    assert reports(desk.tickets) == [Report.ENROLLED]


def test_a52_a_token_is_used_before_anything_is_issued(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(desk.ticket())

    def die(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(desk.authority), "grant", die)
        with pytest.raises(KeyboardInterrupt):
            asked(desk, machine.request())
    restarted = Responder(desk.tickets, desk.authority)
    assert restarted.answer(Machine(machine.ticket).request(), time.time()) == REFUSED  # another key
    assert reports(desk.tickets) == [Report.MISUSED]


def test_a52_the_machine_itself_goes_on_where_its_launcher_was_killed(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(desk.ticket())
    with monkeypatch.context() as patch:
        patch.setattr(Tickets, "complete", lambda *args: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            asked(desk, machine.request())
    request = machine.request()
    with closing(Tickets(desk.folder / "enrolment")) as tickets:
        answer = Responder(tickets, desk.authority).answer(request, time.time())
        assert len(members(desk, machine, request, answer)) == 2


def test_a52_a_token_is_good_for_minutes(desk: Desk) -> None:
    machine = Machine(desk.ticket(minutes=10))
    assert asked(desk, machine.request(), at_s=time.time() + 601) == REFUSED
    assert asked(desk, machine.request(), at_s=time.time() + 599) != REFUSED
    assert asked(desk, Machine(machine.ticket).request(), at_s=time.time() + 7_200) == REFUSED
    assert reports(desk.tickets) == [Report.ENROLLED, Report.MISUSED]  # also long after it ran out


def test_a52_the_token_of_a_machine_that_was_given_back_is_good_for_nothing(desk: Desk) -> None:
    machine = Machine(desk.ticket())
    desk.tickets.delete(CLUSTER.name, "m7")
    assert asked(desk, machine.request()) == b""


# exactly the planned requests


def other_seats(ticket: Ticket, role: Role, label: str) -> list[NodeKeys]:
    return [NodeKeys.generate(ticket.seats[0].role, ticket.seats[0].label), NodeKeys.generate(role, label)]


@pytest.mark.parametrize(("role", "label"), [(Role.RIB, "c-m7"), (Role.PROXY, "robot"), (Role.SWITCH, "c-m7")])
def test_a52_a_machine_becomes_nothing_but_what_was_planned(desk: Desk, role: Role, label: str) -> None:
    ticket = desk.ticket()
    machine = Machine(ticket, other_seats(ticket, role, label))
    before = (desk.authority.domain / "issued.jsonl").exists()
    assert asked(desk, machine.request()) == REFUSED
    assert (desk.authority.domain / "issued.jsonl").exists() == before
    assert reports(desk.tickets) == [Report.MISUSED]


@pytest.mark.parametrize("role", [Role.SWITCH, Role.RIB])
def test_l09_a_machine_that_is_to_be_a_leaf_becomes_no_switch(desk: Desk, role: Role) -> None:
    ticket = desk.ticket()
    proxy = NodeKeys.generate(ticket.seats[1].role, ticket.seats[1].label)
    assert asked(desk, Machine(ticket, [NodeKeys.generate(role, ticket.seats[0].label), proxy]).request()) == REFUSED
    assert reports(desk.tickets) == [Report.MISUSED]


def test_a52_metadata_of_another_name_are_refused(desk: Desk) -> None:
    ticket = desk.ticket()
    keys = [NodeKeys.generate(each.role, each.label, {"site": "elsewhere"}) for each in ticket.seats]
    assert asked(desk, Machine(ticket, keys).request()) == REFUSED


@pytest.mark.parametrize("count", [1, 3])
def test_a52_neither_fewer_nor_more_members_are_admitted(desk: Desk, count: int) -> None:
    machine = Machine(desk.ticket())
    assert asked(desk, machine.request((machine.applications() * 2)[:count])) == REFUSED


def test_a52_a_request_that_another_key_made_is_refused(desk: Desk) -> None:
    ticket = desk.ticket()
    machine, victim = Machine(ticket), Machine(ticket)
    stolen = [
        apply(ticket.token, own.key, theirs.request(), own.kem.public)
        for own, theirs in zip(machine.keys, victim.keys, strict=True)
    ]
    assert asked(desk, machine.request(stolen)) == REFUSED


def test_a52_a_proof_for_another_token_or_kem_key_is_refused(desk: Desk) -> None:
    ticket = desk.ticket()
    machine, elsewhere = Machine(ticket), secrets.token_bytes(32)
    foreign = [apply(elsewhere, each.key, each.request(), each.kem.public) for each in machine.keys]
    assert asked(desk, machine.request(foreign)) == REFUSED
    again = Machine(desk.ticket("m8"))
    swapped = [replace(each, kem=KemPrivateKey.generate().public) for each in again.applications()]
    assert asked(desk, again.request(swapped)) == REFUSED


# the parties that listen and answer


def test_a52_a_request_shows_neither_token_nor_machine_and_is_good_for_its_ticket_alone(desk: Desk) -> None:
    machine, other = Machine(desk.ticket()), Machine(desk.ticket("m8"))
    request = machine.request()
    for secret in (machine.ticket.token, machine.secret, b"c-m7", machine.keys[0].key.public.compressed):
        assert secret not in request
    moved = request[:8] + other.request()[8:HEAD_BYTES] + request[HEAD_BYTES:]
    assert asked(desk, moved) == b""
    assert reports(desk.tickets) == []


def test_a52_an_observer_who_replays_a_request_learns_nothing_and_changes_nothing(desk: Desk) -> None:
    machine = Machine(desk.ticket())
    request = machine.request()
    answer = asked(desk, request)
    replayed = asked(desk, request)
    assert replayed == answer
    got = machine.opened(request, answer)
    assert all(each.member not in replayed for each in got.granted)
    with pytest.raises(StatementError):
        open_answer(machine.ticket.token, request, bytes(32), replayed[4:])  # with the token, without the answer secret
    assert reports(desk.tickets) == [Report.ENROLLED]


class Impostor:
    """Machine in the middle that has read its victim's user data and lacks the responder's private key."""

    def __init__(self, ticket: Ticket, answer: bytes) -> None:
        self._ticket, self._answer = ticket, answer
        self.asked = 0

    def is_expected(self, _: bytes) -> bool:
        return True

    def answer(self, request: bytes, _: float) -> bytes:
        self.asked += 1
        with pytest.raises(StatementError):
            open_request(KemPrivateKey.generate(), request)
        return seal_answer(self._ticket.token, request, bytes(32), self._answer)

    def flush(self) -> None:
        pass


def test_a52_who_knows_the_token_alone_cannot_answer_in_the_launchers_place(desk: Desk, tmp_path: Path) -> None:
    ticket = desk.ticket()
    install(tmp_path / "home", desk.boot(ticket=ticket))
    machine = Machine(ticket)
    request = machine.request()
    forged = machine.opened(request, asked(desk, request)).to_wire()
    impostor = Impostor(ticket, forged)
    desk.responder = impostor  # type: ignore[assignment]
    with desk.listening(), pytest.raises(LocalError, match="an answer that the responder did not make"):
        enrol(tmp_path / "home", patience_s=0.5)
    assert impostor.asked
    assert not list((tmp_path / "home").rglob("node.crt"))


# requests that cost nothing


@pytest.fixture
def dear(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Counter of operations that cost more than a hash."""
    done: list[str] = []
    opened, verified = KemPrivateKey.open, PublicKey._verify

    def counted_open(self: KemPrivateKey, sealed: bytes, info: bytes) -> bytes:
        done.append("open")
        return opened(self, sealed, info)

    def counted_verify(self: PublicKey, signature: bytes, data: bytes, scheme: ec.ECDSA) -> None:
        done.append("verify")
        verified(self, signature, data, scheme)

    monkeypatch.setattr(KemPrivateKey, "open", counted_open)
    monkeypatch.setattr(PublicKey, "_verify", counted_verify)
    return done


def test_a52_a_wrong_token_draws_neither_decapsulation_nor_signature(desk: Desk, dear: list[str]) -> None:
    machine = Machine(desk.ticket())
    request = machine.request()
    dear.clear()
    for index in range(1_000):
        wrong = bytearray(request)
        wrong[-1 - index % 32] ^= 1 + index // 32
        assert asked(desk, bytes(wrong)) == b""
    guessed = Machine(replace(machine.ticket, token=secrets.token_bytes(32))).request()
    dear.clear()
    assert asked(desk, guessed) == b""
    assert dear == []
    assert asked(desk, request) != b""


def test_a52_who_has_a_token_draws_a_bounded_number_of_decapsulations(desk: Desk, dear: list[str]) -> None:
    machine = Machine(desk.ticket())
    requests = [replace(machine, secret=secrets.token_bytes(32)).request() for _ in range(OPENED_MAX + 20)]
    dear.clear()
    for request in requests:
        asked(desk, request)
    assert dear.count("open") == OPENED_MAX
    dear.clear()
    assert asked(desk, requests[OPENED_MAX - 1]) not in (b"", REFUSED)  # the last token again: nothing is opened
    assert dear == []


@pytest.mark.parametrize("size", [0, 1, HEAD_BYTES - 1, HEAD_BYTES, HEAD_BYTES + 40, 2_000, 20_000])
def test_a52_garbage_of_any_length_is_nothing(desk: Desk, size: int) -> None:
    assert asked(desk, os.urandom(size)) == b""
    assert asked(desk, b"GDPE\x01" + os.urandom(size)) == b""


def connected(listener: Listener) -> socket.socket:
    return socket.create_connection(listener.address, 5.0)  # type: ignore[arg-type]


def ends(peer: socket.socket) -> bool:
    peer.settimeout(CONNECTION_S + 5.0)
    try:
        return peer.recv(1) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize(
    "first",
    [b"GET / HTTP/1.1\r\n", b"GDPE\x02", b"GDPE\x01\xff\xff\xff" + bytes(16), b"GDPE\x01\x00\x20\x00" + bytes(16)],
    ids=["other", "version", "too long", "no ticket"],
)
def test_a52_a_connection_ends_at_its_first_wrong_byte(desk: Desk, first: bytes) -> None:
    with desk.listening(bind_tcp("127.0.0.1", 0)) as listener, closing(connected(listener)) as peer:
        begun_s = time.monotonic()
        peer.sendall(first)
        assert ends(peer)
        assert time.monotonic() - begun_s < CONNECTION_S


def test_a52_a_flood_of_a_ticket_holder_takes_no_more_than_a_request(desk: Desk) -> None:
    request = Machine(desk.ticket()).request()
    with desk.listening(bind_tcp("127.0.0.1", 0)) as listener, closing(connected(listener)) as peer:
        with suppress(BrokenPipeError, ConnectionResetError):
            peer.sendall(request + bytes(64 * REQUEST_MAX_BYTES))
        assert ends(peer)


def test_a52_silent_connections_keep_no_machine_out(desk: Desk, tmp_path: Path) -> None:
    bound = bind_tcp("127.0.0.1", 0)
    install(tmp_path / "home", desk.boot(ticket=desk.ticket(address=f"tcp://127.0.0.1:{bound.getsockname()[1]}")))
    with desk.listening(bound) as listener:
        silent = [connected(listener) for _ in range(2 * CONNECTIONS_MAX)]
        assert enrol(tmp_path / "home")
        for each in silent:
            each.close()


def test_a52_a_slow_request_ends_within_seconds(desk: Desk) -> None:
    request = Machine(desk.ticket()).request()
    with desk.listening(bind_tcp("127.0.0.1", 0)) as listener, closing(connected(listener)) as peer:
        begun_s = time.monotonic()
        peer.sendall(request[:40])
        assert ends(peer)
        assert time.monotonic() - begun_s < CONNECTION_S + 4.0


def test_a52_a_machine_enrols_in_a_flood_of_wrong_tokens(desk: Desk, tmp_path: Path) -> None:
    bound = bind_tcp("127.0.0.1", 0)
    ticket = desk.ticket(address=f"tcp://127.0.0.1:{bound.getsockname()[1]}")
    install(tmp_path / "home", desk.boot(ticket=ticket))
    wrong = Machine(replace(ticket, token=secrets.token_bytes(32))).request()
    is_over = False

    def flood(listener: Listener) -> None:
        while not is_over:
            try:
                with closing(connected(listener)) as peer:
                    peer.sendall(wrong)
                    ends(peer)
            except OSError:
                continue

    with desk.listening(bound) as listener, ThreadPoolExecutor(4) as pool:
        floods = [pool.submit(flood, listener) for _ in range(4)]
        try:
            assert enrol(tmp_path / "home")
        finally:
            is_over = True
    assert [each.result() for each in floods] == [None] * 4


# actions of the supervisor


class Recorded(Memory):
    """Provider that keeps its arguments."""

    def __init__(self) -> None:
        super().__init__()
        self.boots: dict[str, MachineBundle] = {}

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        self.boots[spec.name] = boot
        return super().create(spec, boot)

    def ticket(self, name: str) -> Ticket:
        return Ticket.from_json(self.boots[name].files[TICKET_FILE])


@pytest.fixture
def tickets(site: Site) -> Iterator[Tickets]:
    with closing(Tickets(site.enrolment_folder)) as made:
        yield made


def test_a52_a_machine_whose_token_is_used_again_is_named_revoked_and_replaced(
    site: Site, journal: Journal, tickets: Tickets
) -> None:
    provider, responder = Recorded(), Responder(tickets, site.authority)
    ours = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, machines=PLAN.machines[:1]), time.time())
    work(ours, lambda: "m1" in provider.boots and journal.machines("c")[0].id)
    assert responder.answer(Machine(provider.ticket("m1")).request(), time.time()) != REFUSED
    work(ours, lambda: journal.machines("c")[0].issued_credentials.proxy)
    issued_credentials = journal.machines("c")[0].issued_credentials
    assert responder.answer(Machine(provider.ticket("m1")).request(), time.time()) == REFUSED
    work(ours, lambda: list(provider.machines) == ["m2"])
    ours.close()
    (alarm,) = (each for each in journal.events("c") if each.what == "alarm")
    assert alarm.machine == "m1"
    assert issued_credentials.proxy[:16] in alarm.detail
    assert site.revocations is not None
    revoked = {path.stem for path in site.revocations[0].glob("*.revoke")}
    assert revoked == {each[:32] for each in issued_credentials.fingerprints}


def test_a52_a_machine_that_enrols_when_it_is_no_longer_wanted_is_revoked(
    site: Site, journal: Journal, tickets: Tickets
) -> None:
    provider, responder = Recorded(), Responder(tickets, site.authority)
    ours = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, machines=PLAN.machines[:1]), time.time())
    work(ours, lambda: "m1" in provider.boots and journal.machines("c")[0].id)
    assert responder.answer(Machine(provider.ticket("m1")).request(), time.time()) != REFUSED
    record = journal.machines("c")[0]
    journal.put(replace(record, released_unix_s=time.time()), time.time())
    ours.reconcile()
    ours.close()
    assert site.revocations is not None
    assert len(list(site.revocations[0].glob("*.revoke"))) == 2


def test_a52_what_happened_while_no_supervisor_lived_is_acted_on_by_the_next(
    site: Site, journal: Journal, tickets: Tickets
) -> None:
    provider = Recorded()
    first = supervisor(site, journal, provider)
    journal.put_cluster(replace(PLAN, machines=PLAN.machines[:1]), time.time())
    work(first, lambda: "m1" in provider.boots and journal.machines("c")[0].id)
    first.close()
    Responder(tickets, site.authority).answer(Machine(provider.ticket("m1")).request(), time.time())
    second = supervisor(site, journal, provider)
    work(second, lambda: journal.machines("c")[0].issued_credentials.fingerprints)
    second.close()
    assert tickets.pending_reports() == []


def test_a52_an_answer_of_a_wrong_form_is_refused() -> None:
    for head in (b"\x00abc", b"\x02\x00\x00\x01", b"\x01\xff\xff\xff", b"\x01"):
        with pytest.raises(StatementError):
            answer_bytes(head)
