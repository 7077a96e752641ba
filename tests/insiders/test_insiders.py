"""Hostile members that send well-formed, harmful statements: no node ends, no table grows, other flows continue."""

from __future__ import annotations

import os
import random

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from gdp.crypto.statements import StatementType
from tests.insiders.trial import Plan, Trial, prepared

TRIALS = int(os.environ.get("GDP_INSIDERS", "2"))
IS_LONG = "GDP_INSIDERS" in os.environ
WORDS = 150

numbers = st.integers(0, (1 << 32) - 1)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Draw a plan."""
    return Plan(
        draw(st.integers(1, 8)),
        tuple(draw(st.lists(numbers, max_size=3))),
        tuple(draw(st.lists(numbers, min_size=WORDS, max_size=4 * WORDS if IS_LONG else WORDS))),
        draw(st.booleans()),
    )


@settings(
    max_examples=TRIALS,
    deadline=None,
    derandomize=not IS_LONG,
    print_blob=True,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink) if IS_LONG else (Phase.explicit, Phase.generate),
)
@given(plans())
def test_no_statement_of_an_insider_ends_a_node_or_silences_the_others(plan: Plan) -> None:
    with prepared():
        Trial(plan).run()


def test_every_type_of_statement_is_forged_by_every_kind_of_member() -> None:
    plan = Plan(1, (), tuple(range(600)))
    with prepared():
        trial = Trial(plan)
        said = set()
        for word in plan.words:
            utterance = trial.forge.utter(random.Random(word))
            said |= set() if utterance is None else {(utterance.what, utterance.persona.node)}
    assert {what for what, _ in said} >= {each.value for each in StatementType}
    assert len({node for _, node in said}) >= 10
