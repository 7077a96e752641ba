"""Rented machines as members of the border's domain: tokens, delegations, removal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from fog.bootstrap.domain_members import DomainMembers
from gdp.enrolment.channel import connect
from gdp.enrolment.domain_join import Joined, JoinRequest, join_domain
from gdp.nodes.delegation_store import DelegationStore
from gdp.stores.keyring import DELEGATIONS
from gdp.trust.enrolment_wire import MEMBERS, EnrolmentError
from gdp.trust.join_token import JoinToken, fingerprint_of
from gdp.trust.right import Right
from tests.fog.bootstrap.desk import MAP, PLAN
from tests.gdp.enrolment.lab import Lab, running_lab

LABEL = "c-m1"
TOKEN_S = 900.0


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with running_lab(tmp_path) as made:
        yield made


@pytest.fixture
def members(lab: Lab) -> Iterator[DomainMembers]:
    with closing(DomainMembers(lab.files)) as made:
        yield made


def token(members: DomainMembers) -> JoinToken:
    now_s = time.time()
    return members.issue_token(LABEL, [PLAN, MAP], valid_s=TOKEN_S, until_unix_s=now_s + 3_600.0, unix_s=now_s)


def joined(lab: Lab, members: DomainMembers) -> Joined:
    return lab.join(LABEL, token(members))


def test_a_machine_is_found_when_it_has_joined(lab: Lab, members: DomainMembers) -> None:
    assert members.find(LABEL) is None
    machine = joined(lab, members)
    found = members.find(LABEL)
    assert found is not None
    assert found.name == machine.identities[-1].name


def test_a_token_of_a_machine_is_refused_under_another_label(lab: Lab, members: DomainMembers) -> None:
    request = JoinRequest(token=token(members), label="c-m2", directory=lab.folder / "other")
    with pytest.raises(EnrolmentError, match="for the label 'c-m1'"):
        join_domain(request)


def test_a_machine_gets_its_delegations_with_its_memberships(lab: Lab, members: DomainMembers) -> None:
    machine = joined(lab, members)
    held = DelegationStore(machine.directory / "proxy" / DELEGATIONS, machine.identities[-1])
    assert {right for topic in held for right in topic.delegation.rights} == {Right.SERVE, Right.PUBLISH}


def test_nothing_of_a_machine_lasts_longer_than_planned(lab: Lab, members: DomainMembers) -> None:
    machine = joined(lab, members)
    ends = {each.member.not_after_unix_s for each in machine.identities}
    assert all(each <= time.time() + 3_601 for each in ends)
    certificates = [each.membership for each in machine.identities]
    with connect(f"127.0.0.1:{lab.port}", fingerprint_of(machine.root)) as channel:
        channel.identify(machine.identities[-1], bytes(16))
        answer = channel.request({"op": "renew", "certificates": certificates})
    assert MEMBERS.read(answer) == (*certificates,)


def test_a_removed_machine_is_revoked_and_its_endpoint_record_is_gone(lab: Lab, members: DomainMembers) -> None:
    joined(lab, members)
    config = lab.files.config
    assert len(list(config.peers.glob("*.endpoints"))) == 1
    assert members.remove(LABEL, unix_s=time.time())
    assert members.find(LABEL) is None
    assert list(config.peers.glob("*.endpoints")) == []
    assert len(list(config.revocations.glob("*.revoke"))) == 2


def test_the_token_of_a_machine_that_was_given_back_before_it_joined_is_refused(
    lab: Lab, members: DomainMembers
) -> None:
    unused = token(members)
    assert not members.remove(LABEL, unix_s=time.time())
    with pytest.raises(EnrolmentError, match="did not make the token"):
        lab.join(LABEL, unused)
