"""Signatures of the attacks on simulated networks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from typing import Final

import pytest

from tests.insiders.oracle import signing_oracle

# Of these the subject is what genuine or recorded statements fill, cause and outlive, not who may have signed one.
_IDEAL: Final = (
    *("channels", "clocks", "far_input", "joins", "leaf", "place", "quotas", "receipts", "replay", "reverse_path"),
    *("revocations", "sizes"),
)


@pytest.fixture(autouse=True)
def _signatures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Sign by the ideal scheme in these files, by the real one in the others."""
    is_ideal = request.module.__name__.rpartition(".test_")[2] in _IDEAL
    with signing_oracle() if is_ideal else nullcontext():
        yield
