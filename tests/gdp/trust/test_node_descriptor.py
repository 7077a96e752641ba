"""Node descriptors: the public identity that a node shows to owners."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.trust.node_descriptor import NodeDescriptor
from tests.gdp.trust.world import CLOUD, GATEWAY, NOW, ROBOT, SCHOOL, card

WIRE = NodeDescriptor.make(ROBOT)


def refusal(wire: bytes) -> DropReason:
    with pytest.raises(StatementError) as caught:
        NodeDescriptor.from_wire(wire)
    return caught.value.reason


def test_a_card_says_who_the_node_is_and_what_secrets_for_it_are_sealed_to() -> None:
    found = NodeDescriptor.from_wire(WIRE)
    assert (found.name, found.label, found.kem) == (ROBOT.name, "robot", ROBOT.kem.public)


def test_an_owner_can_ask_for_a_member_of_a_domain() -> None:
    assert card().member_of(SCHOOL.root, NOW) == ROBOT.member
    with pytest.raises(StatementError) as caught:
        card().member_of(CLOUD.root, NOW)
    assert caught.value.reason is DropReason.WRONG_DOMAIN


def test_another_key_for_secrets_cannot_be_slipped_in() -> None:
    body = {"member": ROBOT.membership, "kem": GATEWAY.kem.public.wire}
    assert refusal(sign(StatementType.CARD, body, ROBOT.name, GATEWAY.key)) is DropReason.BAD_SIGNATURE
    assert refusal(sign(StatementType.CARD, body, GATEWAY.name, GATEWAY.key)) is DropReason.BAD_CERTIFICATE


@given(st.integers(0, len(WIRE) - 1), st.integers(1, 255))
def test_every_changed_byte_is_refused_with_a_reason(at: int, change: int) -> None:
    altered = bytearray(WIRE)
    altered[at] ^= change
    refusal(bytes(altered))
