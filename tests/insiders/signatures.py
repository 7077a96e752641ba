"""Fixture of folders whose tests sign by the ideal scheme; those marked ``real_signatures`` sign by ECDSA."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import pytest

from tests.insiders.oracle import signing_oracle

__all__ = ["signatures"]


@pytest.fixture(autouse=True)
def signatures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Sign by the ideal scheme, but for the tests whose subject is who may have said something."""
    with nullcontext() if request.node.get_closest_marker("real_signatures") else signing_oracle():
        yield
