"""Policy of a domain."""

from __future__ import annotations

import pytest

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Role
from gdp.crypto.identity import NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import parse
from gdp.errors import DropReason, LocalError, StatementError
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from tests.gdp.trust.world import CLOUD, DAY, NOW, ROBOT, SCHOOL, STRANGER


def refusal(policy: Policy, wire: bytes, unix_s: float = NOW) -> DropReason:
    with pytest.raises(StatementError) as caught:
        policy.verify_membership(wire, unix_s)
    return caught.value.reason


def take_back(policy: Policy, fingerprint: bytes) -> None:
    wire = Revocation.make(SCHOOL.key, SCHOOL.root.subject, fingerprint, DAY.not_after_unix_s)
    assert (
        policy.revoked.receive_revocation(parse(wire), b"a neighbour", Timestamps(0.0, NOW), lambda _: False)
        is not None
    )


def test_a_domain_trusts_itself_and_those_it_names() -> None:
    policy = Policy(SCHOOL.root, [CLOUD.root])
    assert policy.own == SCHOOL.root.domain
    assert policy.trusts(SCHOOL.root.domain)
    assert policy.trusts(CLOUD.root.domain)
    assert not Policy(CLOUD.root).trusts(SCHOOL.root.domain)


def test_traffic_passes_all_trusted_domains_by_default() -> None:
    both = {SCHOOL.root.domain, CLOUD.root.domain}
    assert Policy(SCHOOL.root, [CLOUD.root]).transit == both
    assert Policy(SCHOOL.root, [CLOUD.root], []).transit == {SCHOOL.root.domain}
    assert Policy(SCHOOL.root, [CLOUD.root], [CLOUD.root.domain]).transit == both


def test_traffic_does_not_pass_a_domain_that_is_not_trusted() -> None:
    with pytest.raises(LocalError):
        Policy(SCHOOL.root, [], [CLOUD.root.domain])


def test_a_member_is_verified_once_and_remembered() -> None:
    policy = Policy(SCHOOL.root)
    assert policy.verify_membership(ROBOT.membership, NOW) is policy.verify_membership(ROBOT.membership, NOW)


def test_a_remembered_member_still_runs_out() -> None:
    policy = Policy(SCHOOL.root)
    policy.verify_membership(ROBOT.membership, NOW)
    assert refusal(policy, ROBOT.membership, DAY.not_after_unix_s + 4_000) is DropReason.EXPIRED


def test_a_remembered_member_can_be_revoked() -> None:
    policy = Policy(SCHOOL.root)
    member = policy.verify_membership(ROBOT.membership, NOW)
    take_back(policy, member.fingerprint)
    assert refusal(policy, ROBOT.membership) is DropReason.REVOKED


def test_a_renewed_member_is_let_in_while_its_old_certificate_stays_out() -> None:
    policy = Policy(SCHOOL.root)
    keys = NodeKeys(ROBOT.role, ROBOT.label, ROBOT.member.digest, ROBOT.key, ROBOT.kem)
    take_back(policy, ROBOT.member.fingerprint)
    renewed = keys.join(SCHOOL, DAY)
    assert policy.verify_membership(renewed.membership, NOW).name == ROBOT.name
    assert refusal(policy, ROBOT.membership) is DropReason.REVOKED


def test_a_foreign_member_is_refused() -> None:
    assert refusal(Policy(SCHOOL.root), STRANGER.membership) is DropReason.WRONG_DOMAIN


def test_domains_of_the_same_label_are_distinguished() -> None:
    converter = CertificateAuthority.create("school", SigningKey.generate(), DAY)
    node = NodeKeys.generate(Role.RIB, "rib").join(converter, DAY)
    policy = Policy(SCHOOL.root, [converter.root])
    assert policy.verify_membership(node.membership, NOW).domain == converter.root.domain
    assert policy.verify_membership(ROBOT.membership, NOW).domain == SCHOOL.root.domain
    assert refusal(Policy(SCHOOL.root), node.membership) is DropReason.WRONG_DOMAIN


def test_what_is_remembered_is_bounded() -> None:
    policy = Policy(SCHOOL.root, [CLOUD.root], remembered=1)
    first = policy.verify_membership(ROBOT.membership, NOW)
    policy.verify_membership(STRANGER.membership, NOW)
    assert policy.verify_membership(ROBOT.membership, NOW) is not first
