"""The directory may die: any RIB, of any tier, in any order of names; established flows go on."""

from __future__ import annotations

import pytest
from hypothesis import example, given

from tests.draws import draws
from tests.journeys.directories import Death, Plan, Trial, plans
from tests.journeys.networks import short_leases
from tests.lanes import long_example


def star(*order: int) -> Plan:
    """Return three domains below a fourth, whose only RIB dies; ``order`` is that of the names of the four RIBs."""
    return Plan((0, 0, 0), (1, 1, 1, 1), (1, 1, 1, 1), (), order, ((1, 2, False),), (Death(0, 2.0),))


# The last RIB in reach of a switch fell silent: there was none to turn to.
ALL_NEAR_RIBS_DIE = Plan(
    (0, 1, 2, 0), (1, 2, 2, 1, 1), (2, 0, 1, 2, 0), (), (2, 0, 3, 4, 1), ((0, 0, False),),
    (Death(21, 1.0), Death(22, 3.3), Death(13, 0.2), Death(0, 0.2), Death(14, 0.2)), seed=506,
)  # fmt: skip
# The tier above had been silent for long when a watch was to be renewed there: what it had given was not kept.
A_RIB_WAITS_FOR_A_SILENT_TIER = Plan(
    (0, 0, 2, 3, 3, 1, 6), (2, 2, 1, 1, 1, 1, 1, 1), (0, 0, 1, 1, 1, 2, 1, 1), (), (0, 1, 4, 3, 2, 5),
    ((1, 5, True), (1, 11, True), (8, 9, False)),
    (Death(11, 3.3), Death(6, 0.25), Death(14, 9.0), Death(10, 1.0), Death(16, 0.2), Death(22, 3.3)), seed=569,
)  # fmt: skip


@pytest.mark.momentary("every trial runs for three leases after its last death; hypothesis also draws shorter attempts")
@draws(1, long=16)
@given(plans())
@long_example(star(0, 0, 0, 0))
@long_example(star(1, 0, 0, 0))
@long_example(star(2, 0, 0, 0))
@example(star(3, 0, 0, 0))
@example(ALL_NEAR_RIBS_DIE)
@example(A_RIB_WAITS_FOR_A_SILENT_TIER)
def test_no_established_flow_notices_that_ribs_die(plan: Plan) -> None:
    with short_leases():
        Trial(plan).run()
