"""Whatever one or two links or switches fail, all arrives that graph and policy allow, for longer than every lease."""

from __future__ import annotations

import os

import pytest
from hypothesis import HealthCheck, Phase, given, settings

from tests.journeys.networks import Plan, Trial, plans, reproducible

TRIALS = int(os.environ.get("GDP_RANDOM_NETWORKS", "12"))
IS_LONG = "GDP_RANDOM_NETWORKS" in os.environ


@pytest.mark.momentary("every trial runs for three leases after its last fault; hypothesis also draws shorter attempts")
@settings(
    max_examples=TRIALS,
    deadline=None,
    derandomize=not IS_LONG,  # what the suite draws is the same each time; more of it is drawn anew
    print_blob=True,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink) if IS_LONG else (Phase.explicit, Phase.generate),
)
@given(plans())
def test_all_arrives_that_graph_and_policy_allow(plan: Plan) -> None:
    with reproducible(plan.seed):
        Trial(plan).run()
