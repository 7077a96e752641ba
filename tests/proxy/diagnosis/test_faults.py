"""Each injected fault is named rightly, and how many are."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from gdp.diagnosis.answer import Answer, Cause, Verdict
from gdp.diagnosis.diagnosis import RULES
from tests.pages import ROOT, blocks_between
from tests.proxy.diagnosis.faults import FAULTS, Fault

BEYOND: Final = "EtherType filtered between switches"  # nothing comes from beyond the filter


def check(answer: Answer, cause: Cause) -> None:
    assert (answer.cause, answer.cause.verdict) == (cause, Verdict.FAULT), answer.sentence
    assert answer.sentence.endswith((".", "?"))
    assert answer.command


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.title)
def test_a_fault_is_named_when_every_node_is_asked_directly(fault: Fault, tmp_path: Path) -> None:
    check(fault.inject(tmp_path).explain(fault.asked), fault.cause)


@pytest.mark.parametrize("fault", [each for each in FAULTS if each.title != BEYOND], ids=lambda fault: fault.title)
def test_a_fault_is_named_when_far_nodes_are_asked_by_frames(fault: Fault, tmp_path: Path) -> None:
    check(fault.inject(tmp_path).explain_over_network(fault.asked), fault.cause)


def test_a_fault_that_frames_cannot_tell_is_one_of_two_reasons(tmp_path: Path) -> None:
    fault = next(each for each in FAULTS if each.title == BEYOND)
    answer = fault.inject(tmp_path).explain_over_network(fault.asked)
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
