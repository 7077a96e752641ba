"""Work of a network at rest, in virtual time: keepalives alone call nothing else of a RIB."""

from __future__ import annotations

from collections import Counter

import pytest

from gdp.exchange.anti_entropy import AntiEntropy
from gdp.rib.core import RibCore
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Topology

AT_REST_S = 60.0


def test_a_rib_at_rest_runs_its_own_timers_when_they_are_due_and_not_with_each_keepalive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = DomainPlan("a", ("a1",))
    nodes = (Attachment("a1", "rib", "rib"), Attachment("a1", "proxy", "P"))
    world = Simulation(topology=Topology((), (plan,), nodes), keepalive_ms=None)
    assert world.run_until_attached()
    world.network.run(AT_REST_S)
    (host,) = world.ribs.values()
    counted, keepalives = Counter[str](), 0
    for owner, name in (RibCore, "handle_timer"), (AntiEntropy, "_find_next"):
        before = getattr(owner, name)

        def count(*arguments: object, before: object = before, name: str = name) -> object:
            counted[name] += 1
            return before(*arguments)  # type: ignore[operator]

        monkeypatch.setattr(owner, name, count)
    (port,) = host.attachment.hello_protocol.ports.values()
    begun = port.keepalive_sequence
    world.network.run(AT_REST_S)
    keepalives = port.keepalive_sequence - begun
    assert keepalives > 10 * AT_REST_S
    assert counted["handle_timer"] < AT_REST_S
    assert counted["_find_next"] < 2 * AT_REST_S
