"""Program in the kernel, where that is permitted."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gdp.errors import LocalError
from gdp.ports.kernel.loaded_program import LoadedProgram


def _why_not() -> str:
    try:
        LoadedProgram(1).close()
    except LocalError as error:
        return str(error).partition("\n")[0]
    return ""


_REASON = _why_not()


@pytest.fixture(scope="module", params=[False, True], ids=["for good", "leased"])
def loaded(request: pytest.FixtureRequest) -> Iterator[LoadedProgram]:
    """Program with space for a hundred entries; leased, it is valid for longer than a test takes."""
    if _REASON:
        pytest.skip(_REASON)
    made = LoadedProgram(100, leased=request.param)
    made.renew(3_600)
    yield made
    made.close()


@pytest.fixture
def small() -> Iterator[LoadedProgram]:
    """Program with space for three entries."""
    if _REASON:
        pytest.skip(_REASON)
    made = LoadedProgram(3)
    yield made
    made.close()
