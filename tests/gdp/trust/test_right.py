"""Rights and their wire form."""

from __future__ import annotations

import pytest

from gdp.crypto.cbor import Value
from gdp.crypto.schema import Keyed
from gdp.errors import DropReason, LocalError, StatementError
from gdp.trust.right import DELEGABLE, RIGHTS, Right


def test_rights_come_back() -> None:
    wire = RIGHTS.write(DELEGABLE)
    assert wire == ["call", "publish", "read", "serve"]
    assert RIGHTS.read(wire) == DELEGABLE


@pytest.mark.parametrize("wire", [[], ["attach"], ["fly"], ["read", "attach"], [1], ["read"] * 5], ids=repr)
def test_rights_that_cannot_be_delegated_are_malformed(wire: list[Value]) -> None:
    with pytest.raises(StatementError) as caught:
        Keyed("r", RIGHTS).read({"r": wire})
    assert caught.value.reason is DropReason.MALFORMED


@pytest.mark.parametrize("rights", [set(), {Right.ATTACH}])
def test_no_node_delegates_an_empty_right_or_its_own_location(rights: set[Right]) -> None:
    with pytest.raises(LocalError):
        RIGHTS.write(frozenset(rights))
