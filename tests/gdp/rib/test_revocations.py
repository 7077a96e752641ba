"""Revocations at a RIB: an asker gets those about a name that it lacks."""

from __future__ import annotations

import pytest

from gdp.control.rib_statements import Query, RelayedStatement
from gdp.crypto.statements import StatementType, parse
from gdp.rib.core import RibCore
from gdp.trust.revocations import ID_BYTES, OPERATOR
from tests.gdp.rib.test_core import NAME, START, rib
from tests.gdp.trust.world import CAMERA, LAB, NOW, SWITCH

WIRES = [LAB.revoke(CAMERA, bytes([number]) * 32, NOW + 100) for number in (1, 2)]


def revoked_at(core: RibCore, digest: bytes | None) -> list[bytes]:
    """Return the revocations that a switch gets with the answer to a query that states this digest."""
    query = Query(NAME, 0.0, revoked=digest).to_wire(SWITCH.name, SWITCH.key, SWITCH.membership)
    core.receive(query, SWITCH.name, START)
    found = [parse(each.statement) for each in core.statements_to_send()]
    relayed = [RelayedStatement.from_fields(each.fields) for each in found if each.type is StatementType.RELAY]
    return [each.statement for each in relayed]


@pytest.fixture
def core() -> RibCore:
    core = rib()
    for wire in WIRES:
        core.state.policy.revoked.receive_revocation(parse(wire), OPERATOR, START, lambda _: True)
    return core


def test_an_asker_without_revocations_gets_all_about_the_name(core: RibCore) -> None:
    assert sorted(revoked_at(core, bytes(ID_BYTES))) == sorted(WIRES)


def test_an_asker_that_has_them_all_gets_none(core: RibCore) -> None:
    assert revoked_at(core, core.state.policy.revoked.digest_about(NAME)) == []


def test_an_asker_that_does_not_say_what_it_has_gets_none(core: RibCore) -> None:
    assert revoked_at(core, None) == []
