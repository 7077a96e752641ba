"""Repairs of best-effort images over three switches, one of whose links loses frames."""

from __future__ import annotations

import pytest

from lab.simulation import Simulation
from lab.topology import chain
from tests.journeys.flows import flowing
from tests.lanes import nightly

SOURCE, READER = "s1/left", "s3/right"


@pytest.mark.momentary("a repair takes two round trips of 60 ms; leases play no part in it")
@pytest.mark.parametrize(("loss", "least"), [(0.05, 0.8), *nightly((0.01, 0.95))])
def test_best_effort_images_cross_a_lossy_uplink_of_60_ms(loss: float, least: float) -> None:
    world = Simulation(topology=chain(3), delay_s=0.03)
    assert world.run_until_attached()
    flow = flowing(world, source=SOURCE, readers=(READER,), reliable=False)
    world.network.run(1)
    uplink = world.cables[frozenset(("s1", "s2"))]
    world.cables[frozenset(("s2", "s3"))].delay_s = 0.0005
    uplink.loss = loss
    flow.stream(25, 0.1, 828_000)
    world.network.run(2.5 + 1)
    numbers = flow.numbers(READER)
    assert len([number for number in numbers if number >= 5]) >= least * 20  # the first ones measure the path
    assert numbers == sorted(set(numbers))
    assert flow.publisher.protection.repairs < 2 * 25 * 600 * loss
