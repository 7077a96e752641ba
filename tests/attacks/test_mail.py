"""Attacks of members with mail and offers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import pytest

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.cbor import Value
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.enrolment import domain_client
from gdp.enrolment.channel import Channel
from gdp.enrolment.domain_client import fetch_mail, read_inbox
from gdp.sharing import state as state_module
from gdp.trust.domain import Policy
from gdp.trust.enrolment_wire import Message
from gdp.trust.mail import Mail
from tests.gdp.relay.ends import NOW, domain, member
from tests.gdp.sharing.machines import STRING, Site


class Server:
    """Enrolment server with the mail of one node."""

    def __init__(self, wires: Sequence[bytes]) -> None:
        self._mail: list[tuple[int, bytes]] = list(enumerate(wires, 1))

    def request(self, fields: Mapping[str, object]) -> Message:
        since = cast(int, fields["since"])
        page: list[Value] = []
        for number, wire in self._mail:
            if since < number <= since + 4:
                page.append({"n": number, "m": wire})
        return {"ok": True, "mail": page}


@pytest.fixture
def lab() -> CertificateAuthority:
    return domain("lab")


def test_a88_mail_that_a_member_sends_without_end_leaves_space_in_an_inbox_for_others(
    lab: CertificateAuthority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(domain_client, "INBOX_MAX", 16)
    mallory, owner, victim = (member(lab, label, Role.PROXY) for label in ("mallory", "owner", "victim"))

    def mails(sender: Identity, kind: str, count: int) -> list[bytes]:
        return [Mail.make(sender, victim.name, kind, bytes([number]), NOW) for number in range(count)]

    server = Server([*mails(mallory, "unknown", 40), *mails(owner, "delegation", 2)])
    monkeypatch.setattr("time.time", lambda: NOW)
    fetch_mail(cast(Channel, server), tmp_path)
    kinds = [each.kind for each in read_inbox(tmp_path, Policy(lab.root), victim.name, 0)]
    assert kinds == ["unknown"] * 4 + ["delegation"] * 2


def test_a89_offers_that_a_member_makes_without_end_leave_space_for_those_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_module, "OFFERS_MAX", 8)
    site = Site(tmp_path)
    mallory, robot, server = (site.add(label) for label in ("mallory", "robot", "server"))
    for number in range(9):
        mallory.sharing.expose(mallory.exposing(f"/junk/a{number}", "server", type_name=STRING), site.now_s)
    server.sharing.work(site.now_s)
    robot.sharing.expose(robot.exposing("/state", "server", type_name=STRING), site.now_s)
    report = server.sharing.work(site.now_s)
    assert report.problems == []
    assert [each.sender for each, _ in server.sharing.offers()] == ["mallory"] * 2 + ["robot"]
