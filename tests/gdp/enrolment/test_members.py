"""Members of a domain: the directory, mail, the agent, and removal."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from gdp.config.relay_config import RelayConfig
from gdp.crypto.statements import parse
from gdp.enrolment import agent as agent_module
from gdp.enrolment import desk as desk_module
from gdp.enrolment import registry as registry_module
from gdp.enrolment.agent import DELEGATION_KIND, Agent
from gdp.enrolment.desk import EnrolmentDesk
from gdp.enrolment.domain_client import DomainClient
from gdp.enrolment.removal import remove_machine
from gdp.errors import LocalError, StatementError
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.stores.issue import delegate
from gdp.stores.keyring import CARD, load_identity
from gdp.trust.enrolment_wire import MEMBERS, EnrolmentError, Refusal
from gdp.trust.mail import Mail
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from lab.process import until
from tests.gdp.enrolment.lab import Lab, running_lab

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with running_lab(tmp_path_factory.mktemp("members")) as made:
        for label in ("ada", "bob"):
            made.join(label)
        yield made


@contextmanager
def running(agent: Agent) -> Iterator[Agent]:
    """Run an agent in a thread while within."""
    thread = threading.Thread(target=agent.run)
    thread.start()
    try:
        yield agent
    finally:
        agent.stop()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def _state(folder: Path) -> str:
    path = folder / "agent.json"
    return str(json.loads(path.read_text())["state"]) if path.exists() else ""


def test_every_member_sees_the_machines_of_the_domain_with_their_descriptors(lab: Lab) -> None:
    with DomainClient.open(lab.folder / "ada") as domain:
        machines = {each.label: each for each in domain.nodes()}
    assert {"ada", "bob", "border"} <= machines.keys()
    assert machines["border"].role == "border"
    bob = load_identity(lab.folder / "bob/proxy", time.time())
    assert machines["bob"].name == bob.name
    assert machines["bob"].proxy is not None
    assert machines["bob"].proxy.kem == bob.kem.public


def test_mail_waits_for_its_recipient_and_is_delivered_in_order(lab: Lab) -> None:
    with DomainClient.open(lab.folder / "ada") as ada, DomainClient.open(lab.folder / "bob") as bob:
        for number in range(3):
            ada.send(ada.find("bob").name, "test-order", bytes([number]))
        mails = [each for each in bob.read_mails() if each.kind == "test-order"]
        assert [each.body for each in mails] == [b"\0", b"\1", b"\2"]
        assert {each.sender.label for each in mails} == {"ada"}
        assert [each.body for each in bob.read_mails(mails[1].number)] == [b"\2"]
        for each in mails:
            bob.delete(each.number)
        assert not [each for each in bob.read_mails() if each.kind == "test-order"]


def test_mail_to_a_stranger_is_refused(lab: Lab) -> None:
    with DomainClient.open(lab.folder / "ada") as ada, pytest.raises(EnrolmentError, match="no member of this domain"):
        ada.send(Name(bytes(range(32))), "test", b"")


def test_a_mail_in_the_name_of_another_is_refused(lab: Lab) -> None:
    bob = load_identity(lab.folder / "bob/proxy", time.time())
    with DomainClient.open(lab.folder / "ada") as ada:
        forged = Mail.make(bob, ada.find("border").name, "test", b"", time.time())
        with pytest.raises(EnrolmentError) as refusal:
            ada._channel.request({"op": "send", "mail": forged})
    assert refusal.value.code is Refusal.WRONG_PROOF


def test_a_full_mailbox_refuses_more(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry_module, "_SENDER_MAX", 2)
    with DomainClient.open(lab.folder / "bob") as bob:
        to = bob.find("ada").name
        bob.send(to, "test", b"")
        bob.send(to, "test", b"")
        with pytest.raises(EnrolmentError, match="mailbox is full"):
            bob.send(to, "test", b"")
    with DomainClient.open(lab.folder / "ada") as ada:
        for each in ada.read_mails():
            ada.delete(each.number)


def test_too_long_a_mail_is_refused_at_its_sender(lab: Lab) -> None:
    with DomainClient.open(lab.folder / "ada") as ada, pytest.raises(LocalError, match="at most 12288 bytes"):
        ada.send(ada.find("bob").name, "test", bytes(20_000))


def test_a_mail_whose_content_was_changed_is_refused(lab: Lab) -> None:
    ada = load_identity(lab.folder / "ada/proxy", time.time())
    wire = Mail.make(ada, ada.name, "test", b"content", time.time())
    with pytest.raises(StatementError):
        Mail.from_wire(wire.replace(b"content", b"changed"))


def test_the_agent_says_that_it_is_connected(lab: Lab) -> None:
    with running(Agent(lab.folder / "bob", poll_s=0.2)), DomainClient.open(lab.folder / "ada") as ada:
        until(lambda: ada.find("bob").is_online)
        until(lambda: _state(lab.folder / "bob") == "connected")


def test_the_agent_of_a_border_works_as_any_other(lab: Lab) -> None:
    with running(Agent(lab.files.directory, poll_s=0.2)):
        until(lambda: _state(lab.files.directory) == "connected")
    assert list(lab.files.config.peers.glob("*.endpoints"))


def test_the_agent_installs_a_delegation_of_the_domains_owner(lab: Lab) -> None:
    name = Metadata({"kind": "topic", "name": "/camera", "type": "sensor_msgs/msg/Image"})
    with running(Agent(lab.folder / "bob", poll_s=5.0)), DomainClient.open(lab.files.directory) as owner:
        bob = owner.find("bob")
        assert bob.proxy is not None
        given = delegate(lab.files.config.owner, bob.proxy, name, [Right.READ])
        owner.send(bob.name, DELEGATION_KIND, given.to_wire())
        folder = lab.folder / "bob/proxy/delegations"
        until((folder / f"{given.name.to_text()}.delegation").exists)
        until(lambda: not list((lab.folder / "bob/inbox").glob("*.mail")))


def test_the_agent_keeps_a_delegation_of_a_foreign_owner_for_a_person(lab: Lab, tmp_path: Path) -> None:
    from gdp.stores.issue import make_owner

    make_owner(tmp_path / "owner")
    name = Metadata({"kind": "topic", "name": "/foreign", "type": "sensor_msgs/msg/Image"})
    with running(Agent(lab.folder / "bob", poll_s=5.0)), DomainClient.open(lab.folder / "ada") as ada:
        given = delegate(tmp_path / "owner", lab.folder / "bob/proxy" / CARD, name, [Right.READ])
        ada.send(ada.find("bob").name, DELEGATION_KIND, given.to_wire())
        inbox = lab.folder / "bob/inbox"
        until(lambda: bool(list(inbox.glob("*.mail"))))
    assert not (lab.folder / f"bob/proxy/delegations/{given.name.to_text()}.delegation").exists()


def test_the_agent_renews_memberships_in_time(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent_module, "_RENEW_SHARE", 0.0)
    monkeypatch.setattr(desk_module, "_EARLY_SHARE", 0.0)
    node = lab.folder / "ada/proxy"
    before = load_identity(node, time.time())
    with running(Agent(lab.folder / "ada", poll_s=0.2)):
        until(lambda: load_identity(node, time.time()).member.fingerprint != before.member.fingerprint)
        until(lambda: _state(lab.folder / "ada") == "connected")
    assert load_identity(node, time.time()).name == before.name


def test_a_member_follows_where_the_relays_of_the_domain_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    relays, news = ["127.0.0.1:8443"], EnrolmentDesk.news
    monkeypatch.setattr(EnrolmentDesk, "news", lambda desk, unix_s: replace(news(desk, unix_s), relays=tuple(relays)))
    with running_lab(tmp_path, relay_port=8_443) as lab:
        lab.join("robot")
        path = tmp_path / "robot/relay.yaml"
        path.write_text(f"{path.read_text()}mtu: 1280\n")
        with running(Agent(tmp_path / "robot", poll_s=0.2)):
            until(lambda: _state(tmp_path / "robot") == "connected")
            relays[:] = ["192.0.2.7:443", "[2001:db8::7]:443"]
            until(lambda: "192.0.2.7" in path.read_text())
        relay = RelayConfig.load(path)
    assert [each.endpoints for each in relay.borders] == [tuple(relays)]
    assert relay.mtu == 1280


def test_a_membership_that_has_just_begun_is_not_issued_again(lab: Lab) -> None:
    member = load_identity(lab.folder / "bob/switch", time.time()).membership
    with DomainClient.open(lab.folder / "bob") as bob:
        answer = bob._channel.request({"op": "renew", "certificates": [member]})
    assert MEMBERS.read(answer) == (member,)


def test_a_member_cannot_renew_for_another(lab: Lab) -> None:
    member = load_identity(lab.folder / "ada/switch", time.time()).membership
    with DomainClient.open(lab.folder / "bob") as bob, pytest.raises(EnrolmentError) as refusal:
        bob._channel.request({"op": "renew", "certificates": [member]})
    assert refusal.value.code is Refusal.WRONG_NODES


def test_the_agent_goes_on_while_no_server_answers(tmp_path: Path) -> None:
    with running_lab(tmp_path) as lab:
        lab.join("eve")
    agent = Agent(tmp_path / "eve", jitter=lambda: 0.0)
    with running(agent):
        until(lambda: _state(tmp_path / "eve") == "unreachable")


def test_two_machines_with_one_identity_are_noticed(lab: Lab) -> None:
    lab.join("twin")
    first, second = Agent(lab.folder / "twin", poll_s=0.2), Agent(lab.folder / "twin", poll_s=0.2)

    def is_noticed() -> bool:
        with lab.registry() as registry:
            machine = registry.machine_with("twin")
        return machine is not None and machine.has_double

    with running(first), running(second):
        until(is_noticed)


def test_a_removed_machine_is_revoked_and_its_tunnel_closed(lab: Lab) -> None:
    joined = lab.join("mallory")
    record = lab.files.config.peers / f"{joined.identities[0].name.to_text()}.endpoints"
    assert record.exists()
    with DomainClient.open(lab.folder / "mallory") as mallory:
        removed = remove_machine(lab.files, "mallory")
        with pytest.raises(EnrolmentError, match="was removed from the domain"):
            mallory.nodes()
    assert removed.revoked == 2
    assert not record.exists()
    revoked = {
        Revocation.from_statement(parse(each.read_bytes())).fingerprint
        for each in lab.files.config.revocations.glob("*.revoke")
    }
    assert {each.member.fingerprint for each in joined.identities} <= revoked
    with pytest.raises(EnrolmentError, match="was removed from the domain; join again with a new token"):
        DomainClient.open(lab.folder / "mallory")


def test_the_label_of_a_removed_machine_is_free_again(lab: Lab) -> None:
    lab.join("phoenix")
    remove_machine(lab.files, "phoenix")
    lab.join_again("phoenix")


def test_the_border_cannot_be_removed(lab: Lab) -> None:
    with pytest.raises(LocalError, match="cannot be removed"):
        remove_machine(lab.files, "border")


def test_an_unknown_machine_cannot_be_removed(lab: Lab) -> None:
    with pytest.raises(LocalError, match=r"no machine 'nothing'.*border"):
        remove_machine(lab.files, "nothing")


def test_a_server_that_is_cancelled_in_the_middle_of_an_answer_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancel_server() -> None:
        for task in asyncio.all_tasks():
            if "serve_domain" in repr(task):
                task.cancel()

    async def drain(writer: asyncio.StreamWriter) -> None:
        asyncio.get_running_loop().call_soon(cancel_server)

    with running_lab(tmp_path) as lab:
        lab.join("robot")
        monkeypatch.setattr(asyncio.StreamWriter, "drain", drain)
        with pytest.raises(EnrolmentError), DomainClient.open(lab.folder / "robot") as client:
            client.nodes()
