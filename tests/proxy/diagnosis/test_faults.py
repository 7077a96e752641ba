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
def test_a_fault_is_named_when_every_node_is_asked_directly_and_when_far_nodes_are_asked_by_frames(
    fault: Fault, tmp_path: Path
) -> None:
    injected = fault.inject(tmp_path)
    check(injected.explain(fault.asked), fault.cause)
    far = injected.explain_over_network(fault.asked)
    if fault.title == BEYOND:  # frames cannot tell it from another reason, and the answer has both
        check(far, Cause.LINK_SILENT)
        assert "filters EtherType" in far.sentence
    else:
        check(far, fault.cause)


def test_each_cause_has_one_rule_and_most_have_a_fault() -> None:
    causes = [cause for cause, _ in RULES]
    assert len(set(causes)) == len(causes)
    assert set(Cause) - set(causes) == {Cause.STARTING, Cause.UNKNOWN}
    assert len({fault.cause for fault in FAULTS}) >= 40


def test_the_page_lists_the_causes_in_the_order_in_which_they_are_checked() -> None:
    section = blocks_between(ROOT / "docs/how-to/troubleshoot.md", "Why a name does not arrive")
    (listed,) = (block.text for block in section if block.text.startswith(f"{RULES[0][0].value}, "))
    assert listed.replace("\n", " ").strip().split(", ") == [cause.value for cause, _ in RULES]
