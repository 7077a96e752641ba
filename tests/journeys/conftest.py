"""Check that every journey outlives its leases: a promise that holds only until the first lease ends is none.

A test that built a simulation fails here unless one of them ran for three leases after it had settled, or the test is
marked ``momentary`` with the reason why no lease matters to it.
"""

from __future__ import annotations

from collections.abc import Generator

import pytest

from lab.simulation import Simulation
from tests.insiders.signatures import signatures

__all__ = ["signatures"]

LEASES = 3
_WORLDS = pytest.StashKey[list[Simulation]]()


@pytest.fixture(autouse=True)
def _worlds_are_known(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    worlds = request.node.stash[_WORLDS] = []
    made = Simulation.__post_init__

    def note(world: Simulation) -> None:
        made(world)
        worlds.append(world)

    monkeypatch.setattr(Simulation, "__post_init__", note)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    yield
    complaint = too_short(item.stash.get(_WORLDS, []), item.get_closest_marker("momentary"))
    del item.stash[_WORLDS]  # or all simulations would stay until the session ends
    if complaint:
        pytest.fail(complaint, pytrace=False)


def too_short(worlds: list[Simulation], marker: pytest.Mark | None) -> str:
    """Return why a test does not outlive its leases; empty if it does, or does not have to."""
    if marker is not None:
        reasons = [reason for reason in marker.args if isinstance(reason, str) and reason.strip()]
        return "" if reasons else "momentary needs a reason: why does no lease matter here?"
    if not worlds:
        return ""
    short_s = min(LEASES * world.lease_s - (world.network.now.mono_s - world.settled_s) for world in worlds)
    if short_s <= 0:
        return ""
    return (
        f"this journey ends {short_s:.1f} s of virtual time before {LEASES} leases are over: let it go on"
        " (flow.outlive(), outlive(world, ...)), or mark it momentary and say why no lease matters"
    )
