"""Recomputation of changed paths, one slice at a time, and of all of them in the end."""

from __future__ import annotations

import pytest

from gdp.switch import unicast
from tests.journeys.flows import SERVER, flowing, ring

LONG = frozenset(("nuc2", "nuc3"))


def test_every_path_is_recomputed_when_a_slice_is_one_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unicast, "_REFRESH_AT_ONCE", 1)
    world = ring()
    flow, *_ = [flowing(world, f"/topic{number}") for number in range(4)]
    world.network.set_link(world.cables[LONG], up=False)
    flow.stream(20, 0.01)
    assert world.network.run(10, lambda: flow.has(SERVER, 20))
    assert flow.numbers(SERVER) == list(range(20))
    assert not any(switch.unicast.is_refreshing for switch in world.switches.values())
    flow.outlive()
