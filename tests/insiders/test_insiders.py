"""Hostile members that send well-formed, harmful statements: no node ends, no table grows, other flows continue."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.crypto.statements import StatementType
from tests.draws import IS_LONG, draws
from tests.insiders.trial import Plan, Trial, prepared

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


@pytest.mark.nightly
@draws(2)
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
