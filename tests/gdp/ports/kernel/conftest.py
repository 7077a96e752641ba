"""A program in the kernel, where that is allowed."""

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
    """The program with room for a hundred entries; leased, it is valid for longer than a test takes."""
    if _REASON:
        pytest.skip(_REASON)
    made = LoadedProgram(100, leased=request.param)
    made.renew(3_600)
    yield made
    made.close()


@pytest.fixture
def small() -> Iterator[LoadedProgram]:
    """The program with room for three entries."""
    if _REASON:
        pytest.skip(_REASON)
    made = LoadedProgram(3)
    yield made
    made.close()
