"""Rights and their wire form."""

from __future__ import annotations

import pytest

from gdp.crypto.cbor import Value
from gdp.crypto.fields import Fields
from gdp.errors import DropReason, LocalError, StatementError
from gdp.trust.right import DELEGABLE, Right, rights_from_fields, rights_to_wire


def test_rights_come_back() -> None:
    wire: list[Value] = [*rights_to_wire(DELEGABLE)]
    assert rights_from_fields(Fields({"r": wire}), "r") == DELEGABLE


@pytest.mark.parametrize("wire", [[], ["attach"], ["fly"], ["read", "attach"], [1], ["read"] * 5], ids=repr)
def test_rights_that_cannot_be_delegated_are_malformed(wire: list[Value]) -> None:
    with pytest.raises(StatementError) as caught:
        rights_from_fields(Fields({"r": wire}), "r")
    assert caught.value.reason is DropReason.MALFORMED


@pytest.mark.parametrize("rights", [set(), {Right.ATTACH}])
def test_no_node_delegates_an_empty_right_or_its_own_location(rights: set[Right]) -> None:
    with pytest.raises(LocalError):
        rights_to_wire(rights)
