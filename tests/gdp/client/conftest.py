"""Signatures of the tests of members."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import pytest

from tests.insiders.oracle import signing_oracle

_REAL_SIGNATURES = ("test_hostile_members",)


@pytest.fixture(autouse=True)
def _signatures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Sign by the ideal scheme, but for the files whose subject is who may have said something."""
    is_real = request.module.__name__.rpartition(".")[2] in _REAL_SIGNATURES
    with nullcontext() if is_real else signing_oracle():
        yield
