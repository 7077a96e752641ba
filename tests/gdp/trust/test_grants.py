"""Topic secrets and how they reach a node."""

from __future__ import annotations

import hashlib
import hmac

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, parse, sign
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name
from gdp.trust.grants import (
    DAILY_FROM,
    EPOCH_MAX,
    EPOCH_S,
    Grant,
    begun_epochs,
    daily_epochs,
    make_grant,
    open_grant,
    topic_secret,
)
from tests.gdp.trust.world import CAMERA, GATEWAY, LAB, ROBOT

WIRE = make_grant(LAB.key, LAB.master, CAMERA, 3, ROBOT.name, ROBOT.kem.public)


def refusal(wire: bytes) -> DropReason:
    with pytest.raises(StatementError) as caught:
        open_grant(ROBOT, wire)
    return caught.value.reason


def test_a_node_opens_what_it_was_granted() -> None:
    assert open_grant(ROBOT, WIRE) == Grant(CAMERA.name, 3, topic_secret(LAB.master, CAMERA.name, 3))


def test_a_secret_is_hkdf_of_the_master_as_the_text_says() -> None:
    name, master = Name(bytes(range(32))), b"m" * 32
    extracted = hmac.digest(bytes(32), master, hashlib.sha256)
    expanded = hmac.digest(extracted, b"gdp-topic-secret-1" + name + b"\x01\x02" + b"\x01", hashlib.sha256)
    assert topic_secret(master, name, 0x0102) == expanded


def test_every_topic_and_epoch_has_a_secret_of_its_own() -> None:
    names = [CAMERA.name, ROBOT.name]
    assert len({topic_secret(LAB.master, name, epoch) for name in names for epoch in range(4)}) == 8


def test_another_node_does_not_open_it() -> None:
    with pytest.raises(StatementError) as caught:
        open_grant(GATEWAY, WIRE)
    assert caught.value.reason is DropReason.NOT_FOR_US


def test_a_grant_by_another_key_than_the_owners_is_refused_but_for_who_may_delegate() -> None:
    wire = make_grant(GATEWAY.key, LAB.master, CAMERA, 3, ROBOT.name, ROBOT.kem.public)
    with pytest.raises(StatementError) as caught:
        open_grant(ROBOT, wire)
    assert caught.value.reason is DropReason.BAD_SIGNATURE
    assert open_grant(ROBOT, wire, [GATEWAY.key.public.compressed]).epoch == 3


def altered(**changes: object) -> bytes:
    body = {**parse(WIRE).fields, **changes}
    return sign(StatementType.GRANT, body, CAMERA.name, LAB.key)


def test_a_secret_does_not_open_under_another_epoch() -> None:
    assert refusal(altered(epoch=4)) is DropReason.BAD_TAG


def test_an_altered_seal_does_not_open() -> None:
    assert refusal(altered(sealed=bytes(1_168))) is DropReason.BAD_TAG


def test_a_grant_signed_by_another_is_refused() -> None:
    wire = sign(StatementType.GRANT, dict(parse(WIRE).fields), CAMERA.name, SigningKey.generate())
    assert refusal(wire) is DropReason.BAD_SIGNATURE


def test_a_grant_in_anothers_name_is_refused() -> None:
    wire = sign(StatementType.GRANT, dict(parse(WIRE).fields), ROBOT.name, LAB.key)
    assert refusal(wire) is DropReason.WRONG_NAME


@pytest.mark.parametrize("epoch", [-1, EPOCH_MAX + 1])
def test_an_epoch_that_the_frame_cannot_carry_is_our_own_mistake(epoch: int) -> None:
    with pytest.raises(LocalError):
        topic_secret(LAB.master, CAMERA.name, epoch)


def test_a_master_of_another_length_is_our_own_mistake() -> None:
    with pytest.raises(LocalError):
        topic_secret(b"short", CAMERA.name, 0)


def test_a_repr_shows_no_secret() -> None:
    grant = open_grant(ROBOT, WIRE)
    assert repr(grant.secret) not in repr(grant)


@given(
    days=st.lists(st.integers(DAILY_FROM + 1, DAILY_FROM + 40), min_size=1, max_size=20).map(sorted),
    by_hand=st.sets(st.integers(0, 5), min_size=1),
)
def test_members_that_hold_the_epochs_of_a_day_open_what_is_sealed_until_the_next(
    days: list[int], by_hand: set[int]
) -> None:
    """Whatever days the owner works on, what seals changes at a day's begin only, to what was held before."""
    held, newest = by_hand, max(by_hand)
    for day in days:
        unix_s = day * EPOCH_S + 1.0
        sealing = max(begun_epochs(dict.fromkeys(held, b""), unix_s))
        assert sealing in (newest, max(held))
        after = daily_epochs(held, unix_s)
        assert max(begun_epochs(dict.fromkeys(after, b""), unix_s)) == sealing
        assert day + 1 in after
        assert len(after) <= 3
        held, newest = after, sealing


def test_a_clock_of_long_ago_still_has_a_secret() -> None:
    assert begun_epochs({DAILY_FROM + 2: b"b", DAILY_FROM + 1: b"a"}, 0.0) == {DAILY_FROM + 1: b"a"}
