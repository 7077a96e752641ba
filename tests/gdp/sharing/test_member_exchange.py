"""Shared names through a real enrolment server on loopback."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.cli import share
from gdp.cli.gdp import main
from gdp.enrolment.domain_client import DomainClient
from gdp.sharing.member_exchange import MemberExchange
from gdp.sharing.sharing import Sharing
from gdp.sharing.upkeep import ShareUpkeep
from gdp.stores.keyring import load_delegations
from gdp.trust.enrolment_wire import UnreachableError
from gdp.trust.right import Right
from tests.gdp.enrolment.lab import Lab, running_lab
from tests.gdp.sharing.machines import STRING, importing


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with running_lab(tmp_path) as lab:
        for label in ("robot", "server"):
            lab.join(label)
        yield lab


def gdp(*words: str | Path) -> int:
    """Return the exit code of a command."""
    with pytest.raises(SystemExit) as leaving:
        main([str(word) for word in words])
    return int(leaving.value.code or 0)


def rights(machine: Path) -> list[frozenset[Right]]:
    """Return the rights of a machine's proxy."""
    return [each.rights for each in load_delegations(machine / "proxy" / "delegations")]


def test_members_share_a_topic_with_one_command_each(lab: Lab) -> None:
    robot, server = lab.folder / "robot", lab.folder / "server"
    assert gdp("expose", "/chatter", "--type", STRING, "--to", "server", "--directory", robot) == 0
    assert gdp("import", "/chatter", "--from", "robot", "--directory", server) == 0
    assert (rights(robot), rights(server)) == ([frozenset({Right.PUBLISH})], [frozenset({Right.READ})])


def test_the_border_is_a_node_like_others(lab: Lab) -> None:
    border = lab.files.directory
    assert gdp("share", "/goal", "--type", STRING, "--with", "robot", "--directory", border) == 0
    assert gdp("import", "/goal", "--directory", lab.folder / "robot") == 0
    assert rights(lab.folder / "robot") == [frozenset({Right.READ})]


def test_the_upkeep_of_an_agent_takes_the_mail_that_the_agent_fetched(lab: Lab) -> None:
    robot, server = lab.folder / "robot", lab.folder / "server"
    exchange = MemberExchange(server, fetches=False)
    Sharing(server / "proxy.yaml", exchange).accept(importing("/chatter"), time.time())
    with DomainClient.open(robot) as client:
        client.send(client.find("server").name, "note", b"not about shared names")
    gdp("expose", "/chatter", "--type", STRING, "--to", "server", "--directory", robot)
    upkeep = ShareUpkeep(server, exchange)
    upkeep.work()
    assert rights(server) == []
    with DomainClient.open(server) as client:
        assert [mail.kind for mail in client.read_mails()] == ["note", "share"]
        upkeep.work()
        assert rights(server) == [frozenset({Right.READ})]
        assert [mail.kind for mail in client.read_mails()] == ["note"]
    exchange.close()


def test_a_server_that_is_away_is_asked_again_after_half_a_minute(tmp_path: Path) -> None:
    now_s = [0.0]
    with running_lab(tmp_path) as lab:
        lab.join("robot")
        exchange = MemberExchange(lab.folder / "robot", fetches=True, clock=lambda: now_s[0])
        labels = [each.label for each in exchange.nodes()]
        assert "robot" in labels
    for now_s[0] in (1.0, 29.0):
        assert [each.label for each in exchange.nodes()] == labels
    for now_s[0] in (31.0, 32.0, 62.0):
        with pytest.raises(UnreachableError):
            exchange.nodes()
    exchange.close()


def test_the_only_domain_of_a_machine_needs_no_directory(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    home = lab.folder / "home"
    home.mkdir()
    monkeypatch.setattr(share, "directory_of", lambda name, stated: home / name)
    monkeypatch.chdir(home)
    command = "expose", "/chatter", "--type", STRING, "--to", "server"
    assert gdp(*command) == 2
    (lab.folder / "robot").rename(home / "lab")
    assert gdp(*command) == 0
    assert rights(home / "lab") == [frozenset({Right.PUBLISH})]
