"""Joining of a cluster's machines: content of user data, and limits of a token."""

from __future__ import annotations

import base64
import gzip
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

from fog.bootstrap.bundles import machine_boot
from fog.host.bundle import JOIN_FILE, install, pack
from fog.host.joining import join
from fog.machine import MachineBundle, MachineSpec
from fog.providers.cloud_init import Setup, placed, shell_script, user_data
from fog.site import Site
from fog.supervisor.journal import Journal
from fog.supervisor.supervisor import Supervisor
from gdp.crypto.certificates import Role
from gdp.crypto.identity import NodeKeys
from gdp.crypto.kem import KemPrivateKey
from gdp.crypto.keys import PublicKey, SigningKey, SoftwareKey
from gdp.enrolment import desk as desk_module
from gdp.enrolment.channel import client_context, connect
from gdp.enrolment.desk import OPENED_MAX, EnrolmentDesk
from gdp.enrolment.registry import Registry
from gdp.management.control_socket import connect_control
from gdp.stores.audit_log import verify_audit
from gdp.stores.keyring import load_domain, load_owner
from gdp.trust.enrolment_wire import (
    DELEGATIONS,
    MEMBERS,
    STRANGER_MAX_BYTES,
    EnrolmentError,
    Message,
    Refusal,
    apply,
    encode_message,
)
from gdp.trust.join_token import JOIN_SECRET_BYTES, JoinRole, JoinToken, join_id
from tests.fog.bootstrap.desk import BINDING, CLUSTER, NONCE, Desk, Machine, desk_of, made_desk, memberships
from tests.fog.supervisor.test_supervisor import PLAN, Memory, journal, site, supervisor, work
from tests.gdp.enrolment.lab import running_lab

__all__ = ["journal", "site"]

_END_S = 15.0  # of a stranger's connection, with reserve


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    with made_desk(tmp_path) as made:
        yield made


def refused(desk: Desk, machine: Machine, applications: object = None, *, at_s: float | None = None) -> Refusal | None:
    """Return why a request is refused."""
    with pytest.raises(EnrolmentError) as refusal:
        machine.ask(desk.desk, applications, at_s=at_s)  # type: ignore[arg-type]
    return refusal.value.code


def misused(desk: Desk) -> list[str]:
    return [label for label, _ in desk.members.misuses()]


# content of user data


def launchers_secrets(desk: Desk) -> list[bytes]:
    """Return every private key that the launcher has, in each form in which it might be written."""
    owner, domain = load_owner(desk.authority.owner), load_domain(desk.authority.domain)
    found = [owner.master]
    for key in (owner.key, domain.key):
        numbers = key.private.private_numbers()  # type: ignore[attr-defined]
        found += [numbers.private_value.to_bytes(32, "big"), key.to_pem()]  # type: ignore[attr-defined]
    return [form for each in found for form in (each, each.hex().encode(), base64.b64encode(each))]


def rented() -> MachineBundle:
    """Return the bundle of a rented machine."""
    token = JoinToken(
        root=bytes(32),
        secret=secrets.token_bytes(JOIN_SECRET_BYTES),
        role=JoinRole.MACHINE,
        expires_unix_s=int(time.time()) + 900,
        servers=("198.51.100.7:51820",),
    )
    return machine_boot(CLUSTER, "m7", lambda node: ("run", node.package), token)


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


def test_a52_an_enrolled_machine_keeps_no_token(desk: Desk, tmp_path: Path) -> None:
    token = desk.token()
    install(tmp_path / "home", desk.boot(token=token))
    with desk.listening():
        join(tmp_path / "home")
    left = b"\n".join(path.read_bytes() for path in (tmp_path / "home").rglob("*") if path.is_file())
    assert token.secret not in left
    assert token.to_text().encode() not in left
    assert all(path.stat().st_mode & 0o077 == 0 for path in (tmp_path / "home").rglob("*.key"))


# once


def test_a52_a_token_admits_one_machine_as_it_was_planned(desk: Desk) -> None:
    got = memberships(desk, Machine(desk.token()).ask(desk.desk))
    assert [(each.role, each.label) for each in got] == [(Role.LEAF, "c-m7"), (Role.PROXY, "c-m7")]
    assert all(each.not_after_unix_s <= time.time() + 86_401 for each in got)
    row = desk.registry.machine_with("c-m7")
    assert row is not None
    assert [each.name for each in row.nodes] == [each.name for each in got]
    assert misused(desk) == []
    desk.desk.flush()
    events = verify_audit(desk.authority.domain).events
    assert (events["accepted", "membership leaf"], events["accepted", "enrolment"]) == (1, 1)


def test_a52_who_uses_a_token_after_the_machine_gets_nothing_and_is_reported(desk: Desk) -> None:
    machine = Machine(desk.token())
    proxy = memberships(desk, machine.ask(desk.desk))[-1].name.to_text()
    thief = Machine(machine.token)
    assert refused(desk, thief) is Refusal.USED
    ((label, detail),) = desk.members.misuses()
    assert label == "c-m7"
    assert proxy[:16] in detail
    desk.members.reported(label)
    assert refused(desk, thief) is refused(desk, machine) is Refusal.USED
    assert desk.members.misuses() == []  # reported once


def test_a52_each_refusal_of_a_machines_token_is_in_the_audit_log(desk: Desk) -> None:
    token = desk.token()
    with desk.listening():
        for _ in range(3):
            with connect(token.servers[0], token.root) as channel, suppress(EnrolmentError):
                channel.request(Machine(token).request(None, channel.binding, channel.nonce))
    assert verify_audit(desk.authority.domain).events["refused", "enrolment"] == 2
    lines = [json.loads(each) for each in (desk.authority.domain / "audit.jsonl").read_text().splitlines()]
    about = [(each["action"], each["about"]) for each in lines if each["what"] == "enrolment"]
    assert about == [("accepted", "c-m7"), ("refused", "c-m7"), ("refused", "c-m7")]


def test_a52_a_machine_that_comes_after_a_thief_is_the_alarm(desk: Desk, tmp_path: Path) -> None:
    token = desk.token()
    install(tmp_path / "home", desk.boot(token=token))
    Machine(token).ask(desk.desk)
    with desk.listening(), pytest.raises(EnrolmentError, match="used already by 'c-m7'") as refusal:
        join(tmp_path / "home")
    assert refusal.value.code is Refusal.USED
    assert misused(desk) == ["c-m7"]


def test_a52_a_lost_answer_is_given_again_to_the_same_keys(desk: Desk) -> None:
    machine = Machine(desk.token())
    first = machine.ask(desk.desk)
    assert machine.ask(desk.desk) == first
    assert machine.ask(desk.restarted()) == first
    assert misused(desk) == []


def test_a52_a_token_is_used_before_anything_is_issued(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(desk.token())

    def die(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(desk_module, "admit", die)
        with pytest.raises(KeyboardInterrupt):
            machine.ask(desk.desk)
    with pytest.raises(EnrolmentError, match="used already"):
        Machine(machine.token).ask(desk.restarted())  # another key
    assert misused(desk) == ["c-m7"]


def test_a52_the_machine_itself_goes_on_where_its_launcher_was_killed(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(desk.token())
    with monkeypatch.context() as patch:
        patch.setattr(Registry, "complete_token", lambda *args: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            machine.ask(desk.desk)
    with Registry(desk.files.config.state) as registry:
        answer = machine.ask(EnrolmentDesk(desk.files, registry))
        assert len(memberships(desk, answer)) == 2
        assert len(DELEGATIONS.read(answer)) == 2


def test_a52_a_token_is_good_for_minutes(desk: Desk) -> None:
    machine = Machine(desk.token(minutes=10))
    assert refused(desk, machine, at_s=time.time() + 601) is Refusal.EXPIRED
    assert misused(desk) == []
    assert machine.ask(desk.desk, at_s=time.time() + 590)
    assert refused(desk, Machine(machine.token), at_s=time.time() + 7_200) is Refusal.USED
    assert misused(desk) == ["c-m7"]  # also long after it ran out


def test_a52_the_token_of_a_machine_that_was_given_back_is_good_for_nothing(desk: Desk) -> None:
    unused, used = Machine(desk.token()), Machine(desk.token("m8"), "c-m8")
    used.ask(desk.desk)
    for label in ("c-m7", "c-m8"):
        desk.members.remove(label, unix_s=time.time())
    assert refused(desk, unused) is Refusal.UNKNOWN_TOKEN
    assert refused(desk, used) is refused(desk, Machine(used.token, "c-m8")) is Refusal.USED
    assert misused(desk) == []


# exactly the planned requests


def other_nodes(token: JoinToken, role: Role, label: str) -> list[NodeKeys]:
    return [NodeKeys.generate(token.role.nodes[0][1], "c-m7"), NodeKeys.generate(role, label)]


@pytest.mark.parametrize(("role", "label"), [(Role.RIB, "c-m7"), (Role.PROXY, "robot"), (Role.SWITCH, "c-m7")])
def test_a52_a_machine_becomes_nothing_but_what_was_planned(desk: Desk, role: Role, label: str) -> None:
    token = desk.token()
    ledger = desk.authority.domain / "issued.jsonl"
    before = ledger.read_bytes()
    assert refused(desk, Machine(token, keys=other_nodes(token, role, label))) is Refusal.WRONG_NODES
    assert ledger.read_bytes() == before
    assert misused(desk) == ["c-m7"]
    assert refused(desk, Machine(token)) is Refusal.USED


@pytest.mark.parametrize("role", [Role.SWITCH, Role.RIB])
def test_l09_a_machine_that_is_to_be_a_leaf_becomes_no_switch(desk: Desk, role: Role) -> None:
    keys = [NodeKeys.generate(role, "c-m7"), NodeKeys.generate(Role.PROXY, "c-m7")]
    assert refused(desk, Machine(desk.token(), keys=keys)) is Refusal.WRONG_NODES
    assert misused(desk) == ["c-m7"]


def test_a52_another_label_or_metadata_of_another_name_are_refused(desk: Desk) -> None:
    for name, label, more in (("m7", "c-m8", None), ("m9", "c-m9", {"site": "elsewhere"})):
        token = desk.token(name)
        keys = [NodeKeys.generate(role, label, more) for _, role in token.role.nodes]
        assert refused(desk, Machine(token, label, keys)) is Refusal.WRONG_NODES
    assert misused(desk) == ["c-m7", "c-m9"]


@pytest.mark.parametrize("count", [1, 3])
def test_a52_neither_fewer_nor_more_members_are_admitted(desk: Desk, count: int) -> None:
    machine = Machine(desk.token())
    assert refused(desk, machine, (machine.applications() * 2)[:count]) is Refusal.WRONG_NODES


def test_a52_a_request_that_another_key_made_is_refused(desk: Desk) -> None:
    token = desk.token()
    machine, victim = Machine(token), Machine(token)
    stolen = [
        apply(machine.identifier, own.key, theirs.request(), own.kem.public)
        for own, theirs in zip(machine.keys, victim.keys, strict=True)
    ]
    assert refused(desk, machine, stolen) is Refusal.WRONG_PROOF


def test_a52_a_proof_for_another_token_or_kem_key_is_refused(desk: Desk) -> None:
    machine, elsewhere = Machine(desk.token()), join_id(secrets.token_bytes(JOIN_SECRET_BYTES))
    foreign = [apply(elsewhere, each.key, each.request(), each.kem.public) for each in machine.keys]
    assert refused(desk, machine, foreign) is Refusal.WRONG_PROOF
    again = Machine(desk.token("m8"), "c-m8")
    swapped = [replace(each, kem=KemPrivateKey.generate().public) for each in again.applications()]
    assert refused(desk, again, swapped) is Refusal.WRONG_PROOF


# the parties that listen and answer


class Wiretap:
    """Relay between a machine and the server's socket that keeps each byte of each connection."""

    def __init__(self, listening: socket.socket, server: str) -> None:
        self._listening, self._server = listening, server
        self.sent = list[bytes]()  # by the machine
        self.received = list[bytes]()

    def run(self, connections: int) -> None:
        for _ in range(connections):
            peer, _ = self._listening.accept()
            with closing(peer), closing(plain(self._server)) as server, ThreadPoolExecutor(1) as pool:
                answers = pool.submit(self._copy, server, peer)
                self.sent.append(self._copy(peer, server))
                self.received.append(answers.result())

    @staticmethod
    def _copy(source: socket.socket, sink: socket.socket) -> bytes:
        kept = b""
        with suppress(OSError):
            while data := source.recv(1 << 16):
                kept += data
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
        return kept


def plain(server: str) -> socket.socket:
    return connect_control(Path(server.removeprefix("unix:")), 10.0)


def test_a52_an_observer_who_replays_a_request_learns_nothing_and_changes_nothing(desk: Desk) -> None:
    machine = Machine(desk.token())
    with desk.listening(), socket.create_server(("127.0.0.1", 0)) as listening:
        tap = Wiretap(listening, machine.token.servers[0])
        thread = threading.Thread(target=tap.run, args=(1,))
        thread.start()
        with connect(f"127.0.0.1:{listening.getsockname()[1]}", machine.token.root) as channel:
            answer = channel.request(machine.request(None, channel.binding, channel.nonce))
        thread.join()
        with closing(plain(machine.token.servers[0])) as replay:
            with suppress(OSError):
                replay.sendall(tap.sent[0])
            replay.settimeout(_END_S)
            replayed = until_closed(replay)
        assert machine.ask(desk.desk) == answer
    secrets_ = [
        machine.token.secret,
        machine.identifier,
        b"c-m7",
        *(each.key.public.compressed for each in machine.keys),
    ]
    for secret in [*secrets_, *MEMBERS.read(answer), *DELEGATIONS.read(answer)]:
        assert all(secret not in seen for seen in (tap.sent[0], tap.received[0], replayed))
    assert misused(desk) == []


def until_closed(peer: socket.socket) -> bytes:
    kept = b""
    with suppress(ConnectionResetError):
        while data := peer.recv(1 << 16):
            kept += data
    return kept


def test_a52_a_request_is_good_for_its_connection_and_its_token_alone(desk: Desk) -> None:
    machine, other = Machine(desk.token()), Machine(desk.token("m8"), "c-m8")
    request = machine.request()
    moved = [
        ({**request, "id": other.identifier}, BINDING, NONCE),
        (request, bytes([1]) * 32, NONCE),
        (request, BINDING, bytes([1]) * 32),
    ]
    for each in moved:
        with pytest.raises(EnrolmentError, match="not by the holder of the token"):
            desk.desk.join(*each, time.time())
    assert misused(desk) == []
    assert machine.ask(desk.desk)


def test_a52_who_knows_the_token_alone_cannot_answer_in_the_launchers_place(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine in the middle has read its victim's user data, and lacks the domain's key."""
    token, stolen = desk.token(), desk.desk.root.to_pem()
    asked = list[object]()

    def greeting(self: EnrolmentDesk, nonce: bytes, unix_s: float) -> dict[str, object]:
        return {"v": 1, "root": stolen, "nonce": nonce, "now": int(unix_s)}

    with running_lab(tmp_path, "evil") as evil:
        monkeypatch.setattr(EnrolmentDesk, "greeting", greeting)
        monkeypatch.setattr(EnrolmentDesk, "join", lambda *args: asked.append(args))
        boot = desk.boot(token=replace(token, servers=evil.token().servers))
        install(tmp_path / "home", boot)
        with pytest.raises(EnrolmentError, match=r"not its key.*nothing was sent"):
            join(tmp_path / "home")
    assert asked == []
    assert not list((tmp_path / "home").rglob("node.crt"))


def test_a52_an_answer_of_a_wrong_form_is_refused(desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path / "home", desk.boot())
    right = EnrolmentDesk.join

    def wrong(self: EnrolmentDesk, *args: object) -> Message:
        answer = right(self, *args)  # type: ignore[arg-type]
        return {**answer, "delegations": [b"none"]}

    monkeypatch.setattr(EnrolmentDesk, "join", wrong)
    with desk.listening(), pytest.raises(EnrolmentError, match="the server's response is not valid"):
        join(tmp_path / "home")
    assert not (tmp_path / "home" / "member").exists()


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
    machine = Machine(desk.token())
    request = machine.request()
    guessed = Machine(replace(machine.token, secret=secrets.token_bytes(JOIN_SECRET_BYTES))).request()
    mac = request["mac"]
    assert isinstance(mac, bytes)
    dear.clear()
    for index in range(1_000):
        wrong = bytearray(mac)
        wrong[-1 - index % 32] ^= 1 + index // 32
        with pytest.raises(EnrolmentError):
            desk.desk.join({**request, "mac": bytes(wrong)}, BINDING, NONCE, time.time())
    with pytest.raises(EnrolmentError):
        desk.desk.join(guessed, BINDING, NONCE, time.time())
    assert dear == []
    assert machine.ask(desk.desk)


def test_a52_who_has_a_token_draws_a_bounded_number_of_verifications(desk: Desk, dear: list[str]) -> None:
    machine = Machine(desk.token())
    for _ in range(OPENED_MAX):
        machine.ask(desk.desk)
    dear.clear()
    for _ in range(20):
        assert refused(desk, machine) is Refusal.UNAVAILABLE
    assert dear == []
    assert misused(desk) == []


@pytest.mark.parametrize(
    ("payload", "ends_tls"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", False),
        (b"GDPE\x01" + os.urandom(2_000), False),
        (b"", True),
        (b"\xff\xff\xff\xff" + bytes(16), True),
        (encode_message({"op": "join"}) + bytes(64), True),
        ((STRANGER_MAX_BYTES + 1).to_bytes(4, "big") + bytes(8 * STRANGER_MAX_BYTES), True),
        (b"\0\0\0\x40" + os.urandom(64), True),
    ],
    ids=["other", "an earlier protocol", "nothing", "too long", "no token", "a flood", "garbage"],
)
def test_a52_a_connection_ends_at_what_is_wrong(desk: Desk, payload: bytes, ends_tls: bool) -> None:
    """A silent or slow one ends in time, which ``test_a_slow_stranger_is_closed`` plays."""
    token = desk.token()
    with desk.listening():
        with closing(plain(token.servers[0])) as peer:
            stream = client_context().wrap_socket(peer) if ends_tls else peer
            begun_s = time.monotonic()
            with suppress(OSError):
                stream.sendall(payload)
            if not payload:
                stream.shutdown(socket.SHUT_WR)
            with suppress(OSError):
                while stream.recv(1 << 16):
                    pass
            assert time.monotonic() - begun_s < 5.0
            stream.close()
        with connect(token.servers[0], token.root) as channel:
            assert channel.request(Machine(token).request(None, channel.binding, channel.nonce))["ok"] is True


def test_a52_silent_connections_keep_no_machine_out(desk: Desk, tmp_path: Path) -> None:
    token = desk.token()
    install(tmp_path / "home", desk.boot(token=token))
    with desk.listening():
        silent = [plain(token.servers[0]) for _ in range(100)]
        assert join(tmp_path / "home")
        for each in silent:
            each.close()


def test_a52_a_machine_joins_in_a_flood_of_wrong_tokens(desk: Desk, tmp_path: Path) -> None:
    token = desk.token()
    install(tmp_path / "home", desk.boot(token=token))
    wrong = Machine(replace(token, secret=secrets.token_bytes(JOIN_SECRET_BYTES)))
    is_over = threading.Event()

    def flood() -> None:
        while not is_over.is_set():
            with suppress(EnrolmentError), connect(token.servers[0], token.root) as channel:
                channel.request(wrong.request(None, channel.binding, channel.nonce))

    with desk.listening(), ThreadPoolExecutor(4) as pool:
        floods = [pool.submit(flood) for _ in range(4)]
        try:
            assert join(tmp_path / "home")
        finally:
            is_over.set()
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

    def machine(self, name: str) -> Machine:
        """Return a machine with keys of its own that has read the user data of this one."""
        document = json.loads(self.boots[name].files[JOIN_FILE])
        return Machine(JoinToken.from_text(document["token"]), document["label"])


@pytest.fixture
def local(site: Site) -> Iterator[Desk]:
    with desk_of(site) as made:
        yield made


@contextmanager
def requested(site: Site, journal: Journal, provider: Recorded) -> Iterator[Supervisor]:
    """Yield a supervisor whose machine m1 boots."""
    with closing(supervisor(site, journal, provider)) as ours:
        journal.put_cluster(replace(PLAN, machines=PLAN.machines[:1]), time.time())
        work(ours, lambda: "m1" in provider.boots and journal.machines("c")[0].id)
        yield ours


def joins(desk: Desk, machine: Machine, home: Path) -> list[str]:
    """Let a machine join as its first start does; return the fingerprints of its memberships."""
    home.mkdir()
    document = {"token": machine.token.to_text(), "label": machine.label}
    (home / JOIN_FILE).write_text(json.dumps(document))
    (home / JOIN_FILE).chmod(0o600)
    with desk.listening():
        assert join(home)
    row = desk.registry.machine_with(machine.label)
    assert row is not None
    return [each.hex() for each in desk.registry.fingerprints(row.id)]


def revoked(site: Site) -> set[str]:
    assert site.revocations is not None
    return {path.stem for path in site.revocations[0].glob("*.revoke")}


def test_a52_a_machine_whose_token_is_used_again_is_named_revoked_and_replaced(
    site: Site, journal: Journal, local: Desk, tmp_path: Path
) -> None:
    provider = Recorded()
    with requested(site, journal, provider) as ours:
        fingerprints = joins(local, provider.machine("m1"), tmp_path / "home")
        work(ours, lambda: journal.machines("c")[0].issued_credentials.proxy)
        proxy = journal.machines("c")[0].issued_credentials.proxy
        assert refused(local, provider.machine("m1")) is Refusal.USED
        work(ours, lambda: list(provider.machines) == ["m2"])
    (alarm,) = (each for each in journal.events("c") if each.what == "alarm")
    assert alarm.machine == "m1"
    assert proxy[:16] in alarm.detail
    assert revoked(site) == {each[:32] for each in fingerprints}


def test_a52_a_misuse_is_an_alarm_alone_where_the_site_says_so(
    site: Site, journal: Journal, local: Desk, tmp_path: Path
) -> None:
    provider = Recorded()
    lenient_enrolment = site.config.enrolment.model_copy(update={"revoke_misused": False})
    lenient = replace(site, config=site.config.model_copy(update={"enrolment": lenient_enrolment}))
    with requested(lenient, journal, provider) as ours:
        joins(local, provider.machine("m1"), tmp_path / "home")
        work(ours, lambda: journal.machines("c")[0].issued_credentials.proxy)
        refused(local, provider.machine("m1"))
        work(ours, lambda: [each for each in journal.events("c") if each.what == "alarm"])
        ours.reconcile()
    assert [each.what for each in journal.events("c")].count("alarm") == 1
    assert list(provider.machines) == ["m1"]
    assert revoked(site) == set()


def test_a52_a_machine_that_joins_when_it_is_no_longer_wanted_is_revoked(
    site: Site, journal: Journal, local: Desk, tmp_path: Path
) -> None:
    provider = Recorded()
    with requested(site, journal, provider) as ours:
        joins(local, provider.machine("m1"), tmp_path / "home")
        journal.put(replace(journal.machines("c")[0], released_unix_s=time.time()), time.time())
        ours.reconcile()
    assert len(revoked(site)) == 2


def test_a52_what_happened_while_no_supervisor_lived_is_acted_on_by_the_next(
    site: Site, journal: Journal, local: Desk, tmp_path: Path
) -> None:
    provider = Recorded()
    with requested(site, journal, provider):
        pass
    joins(local, provider.machine("m1"), tmp_path / "home")
    refused(local, provider.machine("m1"))
    with closing(supervisor(site, journal, provider)) as second:
        work(second, lambda: list(provider.machines) == ["m2"])
    assert len(revoked(site)) == 2
    assert local.members.misuses() == []
