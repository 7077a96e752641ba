"""Each injected fault is named rightly, and how many are."""

from __future__ import annotations

from typing import Final, NamedTuple

import pytest

from gdp.diagnosis.answer import Answer, Cause, Verdict
from gdp.diagnosis.diagnosis import RULES
from tests.pages import ROOT, blocks_between
from tests.proxy.diagnosis.faults import FAULTS, Fault
from tests.proxy.diagnosis.stage import Stage

BEYOND: Final = "EtherType filtered between switches"  # nothing comes from beyond the filter
ORDERED: Final = sorted(FAULTS, key=lambda fault: fault.title == BEYOND)  # so that a stage serves its tests in a row


def check(answer: Answer, cause: Cause) -> None:
    assert (answer.cause, answer.cause.verdict) == (cause, Verdict.FAULT), answer.sentence
    assert answer.sentence.endswith((".", "?"))
    assert answer.command


class Injected(NamedTuple):
    """A fault, and the stage that has it."""

    fault: Fault
    stage: Stage


@pytest.fixture(scope="module")
def injected(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Injected:
    """Return the stage of a fault, for all tests of that fault."""
    return Injected(request.param, request.param.inject(tmp_path_factory.mktemp("stage")))


def _title(fault: Fault) -> str:
    return fault.title


@pytest.mark.parametrize("injected", ORDERED, indirect=True, ids=_title)
def test_a_fault_is_named_when_every_node_is_asked_directly(injected: Injected) -> None:
    check(injected.stage.explain(injected.fault.asked), injected.fault.cause)


@pytest.mark.parametrize("injected", ORDERED[:-1], indirect=True, ids=_title)
def test_a_fault_is_named_when_far_nodes_are_asked_by_frames(injected: Injected) -> None:
    check(injected.stage.explain_over_network(injected.fault.asked), injected.fault.cause)


@pytest.mark.parametrize("injected", ORDERED[-1:], indirect=True, ids=_title)
def test_a_fault_that_frames_cannot_tell_is_one_of_two_reasons(injected: Injected) -> None:
    answer = injected.stage.explain_over_network(injected.fault.asked)
    check(answer, Cause.LINK_SILENT)
    assert "filters EtherType" in answer.sentence


def test_each_cause_has_one_rule_and_most_have_a_fault() -> None:
    assert set(Cause) - RULES.keys() == {Cause.STARTING, Cause.UNKNOWN}
    assert len(set(RULES.values())) == len(RULES)
    assert len({fault.cause for fault in FAULTS}) >= 40


def test_the_page_lists_the_causes_in_the_order_in_which_they_are_checked() -> None:
    section = blocks_between(ROOT / "docs/how-to/troubleshoot.md", "Why a name does not arrive")
    causes = [cause.value for cause in RULES]
    (listed,) = (block.text for block in section if block.text.startswith(f"{causes[0]}, "))
    assert listed.replace("\n", " ").strip().split(", ") == causes
