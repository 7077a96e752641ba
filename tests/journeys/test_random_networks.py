"""Random networks: under failures of links and switches, all deliveries that graph and policy permit arrive."""

from __future__ import annotations

import pytest
from hypothesis import example, given

from tests.draws import draws
from tests.journeys.networks import Fault, Plan, Trial, plans, short_leases
from tests.lanes import long_example

# The path within a domain was longer than one through its neighbour, which sent back the frames that left.
LOOPED_AT_A_BORDER = Plan(
    (9, 6, 6, 4), (0, 1, 1), (), (), (2, 3, 0, 0), (3, 0), frozenset({2}), (Fault(False, 0, 2.0),), seed=1
)
# Two tiers up, an advertisement was taken for one of the tier between, through which its frames then might not pass.
THREE_TIERS = Plan(
    (1, 7, 3, 6, 2, 4), (0, 1, 1, 0, 0), (), ((9, 13, 20, 26), (31, 36, 31, 39)), (6, 4, 4, 4, 3, 8), (22, 28, 12),
    frozenset({3}), (Fault(False, 141, 2.1),), seed=304,
)  # fmt: skip
# The only RIB of a middle tier dies with its switch; what its tier knew of the others ended with their leases.
MIDDLE_TIER_DIES = Plan(
    (2, 4, 1, 9, 2), (0, 1, 1, 0), (), (), (2, 5, 6, 7, 3), (29, 28, 2), frozenset(),
    (Fault(True, 44, 2.0), Fault(True, 75, 2.0)), seed=175,
)  # fmt: skip


@pytest.mark.momentary("every trial runs for three leases after its last fault; hypothesis also draws shorter attempts")
@draws(1, long=8)
@given(plans())
@long_example(LOOPED_AT_A_BORDER)
@example(THREE_TIERS)
@example(MIDDLE_TIER_DIES)
def test_all_arrives_that_graph_and_policy_allow(plan: Plan) -> None:
    with short_leases():
        Trial(plan).run()
