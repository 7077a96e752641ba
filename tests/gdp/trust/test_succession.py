"""Successors: of a domain's root, and of an owner's key."""

from __future__ import annotations

import pytest

from gdp.crypto.ca import CertificateAuthority
from gdp.crypto.certificates import Membership, Role, Root
from gdp.crypto.identity import NodeKeys
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import parse
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import CLOCK_SKEW_S
from gdp.sansio import Timestamps
from gdp.trust.adcert import AdCertCache, Chain
from gdp.trust.domain import Policy
from gdp.trust.owner import Owner, successor_subject
from gdp.trust.revocation import Revocation
from gdp.trust.right import Right
from tests.gdp.trust.world import (
    CAMERA,
    CAMERA_METADATA,
    CLOUD,
    DAY,
    GATEWAY,
    LAB,
    NOW,
    ROBOT,
    SCHOOL,
    advertisement,
    card,
    verifier,
)

RETIRES = NOW + 3_600
HEIR = SCHOOL.succeed(SigningKey.generate(), DAY, RETIRES)
YOUNG = NodeKeys.generate(Role.PROXY, "young").join(HEIR, DAY)


def refusal(policy: Policy, wire: bytes, unix_s: float = NOW) -> DropReason:
    with pytest.raises(StatementError) as caught:
        policy.verify_membership(wire, unix_s)
    return caught.value.reason


def test_a_successor_keeps_the_domain_and_comes_back_from_its_file() -> None:
    assert HEIR.root.domain == SCHOOL.root.domain
    assert Root.from_wire(HEIR.root.to_pem()) == HEIR.root
    third = HEIR.succeed(SigningKey.generate(), DAY, RETIRES + 60)
    assert [each.key for each in Root.from_wire(third.root.to_pem()).lineage] == [
        SCHOOL.root.key, HEIR.root.key, third.root.key,
    ]  # fmt: skip


def test_both_are_believed_until_the_first_retires() -> None:
    policy = Policy(HEIR.root)
    for moment in (NOW, RETIRES + CLOCK_SKEW_S):
        assert policy.verify_membership(ROBOT.membership, moment).domain == SCHOOL.root.domain
        assert policy.verify_membership(YOUNG.membership, moment).domain == SCHOOL.root.domain
    late = RETIRES + CLOCK_SKEW_S + 1
    assert refusal(policy, ROBOT.membership, late) is DropReason.EXPIRED
    policy.verify_membership(YOUNG.membership, late)


def test_who_has_the_first_root_only_does_not_believe_the_second() -> None:
    assert refusal(Policy(SCHOOL.root), YOUNG.membership) is DropReason.WRONG_DOMAIN


def test_a_policy_takes_on_a_successor_and_nothing_else() -> None:
    policy = Policy(SCHOOL.root, [CLOUD.root])
    converter = CertificateAuthority.create("school", SigningKey.generate(), DAY)
    for stranger in (converter.root, CLOUD.succeed(SigningKey.generate(), DAY, RETIRES).root):
        if stranger.domain == CLOUD.root.domain:
            policy.renew_roots([stranger])
        else:
            with pytest.raises(LocalError, match="another domain"):
                policy.renew_roots([stranger])
    policy.renew_roots([HEIR.root])
    assert policy.verify_membership(YOUNG.membership, NOW).label == "young"
    with pytest.raises(LocalError, match="did not vouch"):
        policy.renew_roots([SCHOOL.succeed(SigningKey.generate(), DAY, RETIRES).root])


def test_another_roots_successor_is_no_successor() -> None:
    with pytest.raises(StatementError):
        SCHOOL.root.succeeded_by(CLOUD.succeed(SigningKey.generate(), DAY, RETIRES).root.wire)
    with pytest.raises(StatementError):
        Root.from_wire(HEIR.root.wire)  # without the root that it succeeds
    with pytest.raises(StatementError):
        SCHOOL.root.succeeded_by(SCHOOL.root.wire)
    with pytest.raises(LocalError, match="another key"):
        SCHOOL.succeed(SCHOOL.key, DAY, RETIRES)


def take_back(policy: Policy, key: SigningKey, signer: Subject, fingerprint: bytes) -> None:
    wire = Revocation.make(key, signer, fingerprint, DAY.not_after_unix_s)
    assert (
        policy.revoked.receive_revocation(parse(wire), b"a neighbour", Timestamps(0.0, NOW), lambda _: True) is not None
    )


def test_a_member_names_no_founder() -> None:
    """The URI of a successor counts in a root only: a member with it could take a name of another key."""
    forged = NodeKeys.generate(Role.PROXY, "forged")
    assert Membership.from_wire(forged.join(HEIR, DAY).membership, HEIR.root, NOW).key == forged.key.public


def test_a_successor_takes_back_what_its_predecessor_issued_and_not_the_other_way() -> None:
    policy = Policy(HEIR.root)
    take_back(policy, SCHOOL.key, SCHOOL.root.signer, YOUNG.member.fingerprint)
    policy.verify_membership(YOUNG.membership, NOW)
    take_back(policy, HEIR.key, HEIR.root.signer, ROBOT.member.fingerprint)
    assert refusal(policy, ROBOT.membership) is DropReason.REVOKED


def test_a_membership_is_renewed_with_its_key_role_and_label() -> None:
    renewed = HEIR.renew(ROBOT.member, DAY)
    assert (renewed.subject, renewed.role, renewed.label) == (ROBOT.member.subject, Role.PROXY, "robot")
    assert renewed.fingerprint != ROBOT.member.fingerprint
    with pytest.raises(LocalError, match="another domain"):
        CLOUD.renew(ROBOT.member, DAY)


def test_an_identity_is_renewed_with_its_own_membership_only() -> None:
    node = NodeKeys.generate(Role.PROXY, "node").join(SCHOOL, DAY)
    node.renew(HEIR.renew(node.member, DAY), HEIR.root)
    assert node.member.issuer_key == HEIR.root.key.compressed
    with pytest.raises(LocalError, match="another node"):
        node.renew(ROBOT.member, SCHOOL.root)


def heir(owner: Owner = LAB, validity: Validity = DAY) -> Owner:
    key = SigningKey.generate()
    given = owner.succeed(key.public, CAMERA, validity)
    return Owner(key, owner.master, owner.public, {CAMERA.name: given.chain})


def test_a_successor_of_an_owner_delegates_its_names() -> None:
    successor = heir()
    assert successor.subject(CAMERA_METADATA) == CAMERA
    given = successor.delegate(card(), CAMERA_METADATA, [Right.PUBLISH], [0], DAY)
    given.verify(ROBOT, NOW)
    assert given.open(ROBOT)[0].secret == LAB.delegate(
        card(), CAMERA_METADATA, [Right.PUBLISH], [0], DAY
    ).open(ROBOT)[0].secret  # fmt: skip
    verifier().verify(advertisement(chain=given.chain), NOW)


def test_two_successions_leave_space_for_two_links() -> None:
    second = heir(heir())
    given = second.delegate(card(GATEWAY), CAMERA_METADATA, [Right.PUBLISH], [0], DAY, may_delegate=True)
    assert len(given.chain) == 3
    assert len(Chain.traverse(given.chain, CAMERA, GATEWAY.subject, AdCertCache(4)).links) == 3
    with pytest.raises(LocalError, match="chain"):
        heir(heir(second)).delegate(card(), CAMERA_METADATA, [Right.PUBLISH], [0], DAY)


def test_what_a_successor_gave_ends_with_its_succession() -> None:
    given = heir(validity=Validity(NOW, NOW + 60)).delegate(card(), CAMERA_METADATA, [Right.PUBLISH], [0], DAY)
    with pytest.raises(StatementError) as caught:
        given.verify(ROBOT, NOW + 60 + CLOCK_SKEW_S + 1)
    assert caught.value.reason is DropReason.EXPIRED


def test_a_successor_has_no_name_that_it_was_not_given() -> None:
    successor = heir()
    other = LAB.subject(type(CAMERA_METADATA)({**CAMERA_METADATA, "name": "/other"}))
    with pytest.raises(LocalError, match="did not succeed"):
        successor.succeed(SigningKey.generate().public, other, DAY)


def test_a_grant_by_somebody_who_may_not_delegate_is_refused() -> None:
    stranger = Owner(SigningKey.generate(), LAB.master, LAB.public, {CAMERA.name: ()})
    given = stranger.delegate(card(), CAMERA_METADATA, [Right.PUBLISH], [0], DAY)
    with pytest.raises(StatementError) as caught:
        given.open(ROBOT)
    assert caught.value.reason in (DropReason.NOT_DELEGATED, DropReason.BAD_SIGNATURE)


def test_a_successor_takes_back_what_it_gave() -> None:
    successor = heir()
    given = successor.delegate(card(), CAMERA_METADATA, [Right.PUBLISH], [0], DAY)
    chain = Chain.traverse(given.chain, CAMERA, ROBOT.subject, AdCertCache(4))
    policy = Policy(SCHOOL.root)
    assert successor.signer == successor_subject(successor.key.public)
    take_back(policy, successor.key, successor.signer, chain.links[-1].fingerprint)
    with pytest.raises(StatementError) as caught:
        chain.check(Right.PUBLISH, NOW, policy.revoked)
    assert caught.value.reason is DropReason.REVOKED
