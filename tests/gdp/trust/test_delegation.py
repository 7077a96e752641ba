"""Delegations: an owner's permission for a node, as one file."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.cbor import decode, encode
from gdp.crypto.validity import Validity
from gdp.errors import DropReason, LocalError, StatementError
from gdp.metadata import Metadata
from gdp.trust.delegation import EPOCHS_MAX, Delegation
from gdp.trust.grants import topic_secret
from gdp.trust.right import Right
from tests.gdp.trust.world import (
    CAMERA,
    CAMERA_METADATA,
    DAY,
    GATEWAY,
    HOUR,
    LAB,
    LATER,
    NOW,
    ROBOT,
    adcert,
    advertisement,
    card,
)
from tests.gdp.trust.world import verifier as new_verifier

GIVEN = LAB.delegate(card(), CAMERA_METADATA, [Right.PUBLISH, Right.READ], [0, 1, 7], DAY)


def refusal(delegation: Delegation, unix_s: float = NOW) -> DropReason:
    with pytest.raises(StatementError) as caught:
        delegation.verify(ROBOT, unix_s)
    return caught.value.reason


def test_a_delegation_comes_back_from_its_file() -> None:
    again = Delegation.from_wire(GIVEN.to_wire())
    assert again.to_wire() == GIVEN.to_wire()
    assert (again.name, again.node, again.rights) == (CAMERA.name, ROBOT.name, frozenset({Right.PUBLISH, Right.READ}))
    assert dict(again.metadata or {}) == dict(CAMERA_METADATA)


def test_it_holds_and_its_advertisement_is_believed() -> None:
    GIVEN.verify(ROBOT, NOW)
    assert new_verifier().verify(advertisement(subject=GIVEN.subject, chain=GIVEN.chain), NOW).name == CAMERA.name


def test_it_opens_to_the_secrets_of_its_epochs() -> None:
    opened = GIVEN.open(ROBOT)
    assert {epoch: grant.secret for epoch, grant in opened.items()} == {
        epoch: topic_secret(LAB.master, CAMERA.name, epoch) for epoch in (0, 1, 7)
    }


def test_another_node_cannot_use_it() -> None:
    with pytest.raises(StatementError) as caught:
        GIVEN.verify(GATEWAY, NOW)
    assert caught.value.reason is DropReason.NOT_FOR_US
    with pytest.raises(StatementError):
        GIVEN.open(GATEWAY)


def test_rights_that_the_chain_does_not_give_are_refused() -> None:
    assert refusal(replace(GIVEN, rights=frozenset({Right.SERVE}))) is DropReason.NOT_DELEGATED


def test_a_chain_of_another_node_is_refused() -> None:
    assert refusal(replace(GIVEN, chain=(adcert(GATEWAY),))) is DropReason.NOT_DELEGATED


def test_no_chain_is_refused() -> None:
    assert refusal(replace(GIVEN, chain=())) is DropReason.NOT_DELEGATED


def test_it_runs_out() -> None:
    short = LAB.delegate(card(), CAMERA_METADATA, [Right.READ], [0], HOUR)
    assert refusal(short, LATER) is DropReason.EXPIRED


def test_a_grant_under_another_epoch_is_refused() -> None:
    swapped = replace(GIVEN, grants={0: GIVEN.grants[1]})
    with pytest.raises(StatementError) as caught:
        swapped.open(ROBOT)
    assert caught.value.reason is DropReason.MALFORMED


def test_metadata_of_another_name_are_refused() -> None:
    wire = replace(GIVEN, metadata=Metadata({"kind": "topic", "name": "/other"})).to_wire()
    with pytest.raises(StatementError) as caught:
        Delegation.from_wire(wire)
    assert caught.value.reason is DropReason.WRONG_NAME


def test_metadata_may_be_left_out() -> None:
    assert Delegation.from_wire(replace(GIVEN, metadata=None).to_wire()).metadata is None


@pytest.mark.parametrize("field", ["format", "name", "digest", "owner", "node", "rights", "chain", "grants"])
def test_a_file_that_lacks_a_field_is_malformed(field: str) -> None:
    body = decode(GIVEN.to_wire())
    assert isinstance(body, dict)
    del body[field]
    with pytest.raises(StatementError) as caught:
        Delegation.from_wire(encode(body))
    assert caught.value.reason is DropReason.MALFORMED


@given(st.binary(max_size=100))
def test_arbitrary_bytes_are_malformed(wire: bytes) -> None:
    with pytest.raises(StatementError) as caught:
        Delegation.from_wire(wire)
    assert caught.value.reason is DropReason.MALFORMED


@pytest.mark.parametrize("rights", [[], [Right.ATTACH], [Right.READ, Right.ATTACH]])
def test_rights_that_cannot_be_given_are_our_own_mistake(rights: list[Right]) -> None:
    with pytest.raises(LocalError):
        LAB.delegate(card(), CAMERA_METADATA, rights, [0], Validity(NOW, NOW + 1))


def test_more_epochs_than_a_file_holds_are_our_own_mistake() -> None:
    with pytest.raises(LocalError):
        replace(GIVEN, grants=dict.fromkeys(range(EPOCHS_MAX + 1), b"")).to_wire()
