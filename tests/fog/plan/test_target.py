"""Number of machines for a target availability, with shared regions."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fog.catalog.measured import measured
from fog.catalog.prices import local_offers
from fog.cluster import MachineRequest
from fog.hardware import Hardware
from fog.plan.target import machines_for
from gdp.errors import LocalError

SPOT = MachineRequest(Hardware(cpus=1), is_spot=True)
STEADY = MachineRequest(Hardware(cpus=1))
OFFERS = tuple(local_offers())


@pytest.mark.parametrize(
    ("availability", "listed", "count"),
    [
        (0.9, [SPOT], 1),
        (0.9995, [SPOT], 2),  # the worked example of the paper: two fail together less than 0.05 % of the time
        (0.99999, [SPOT], 4),
        (0.995, [STEADY], 1),
        (0.9999, [STEADY, SPOT], 3),
    ],
)
def test_as_many_machines_as_the_target_takes(availability: float, listed: list[MachineRequest], count: int) -> None:
    target = machines_for(availability, listed, OFFERS, measured())
    assert len(target.machines) == count
    assert target.p_system <= 1 - availability
    assert target.machines[: len(listed)] == tuple(listed)
    assert target.assumptions


def test_machines_that_share_a_region_count_as_failing_together() -> None:
    offers = tuple(each for each in OFFERS if each.region == "local-a")
    shared = machines_for(0.9985, [SPOT], offers, measured())
    assert len(shared.machines) > len(machines_for(0.9985, [SPOT], OFFERS, measured()).machines)


def test_a_target_that_is_out_of_reach_is_refused_with_what_is_reached() -> None:
    together = replace(measured(), pairs=tuple(replace(each, free_together=50.0) for each in measured().pairs))
    with pytest.raises(LocalError, match=r"out of reach: .* is 0\.978\d*, with 1"):
        machines_for(0.9995, [SPOT], tuple(each for each in OFFERS if each.region == "local-a"), together)


@pytest.mark.parametrize("availability", [0.0, 1.0, 99.95])
def test_an_availability_that_is_no_share_is_refused(availability: float) -> None:
    with pytest.raises(LocalError, match=r"such as 0\.9995"):
        machines_for(availability, [SPOT], OFFERS, measured())
