"""Answers from facts alone: what is said where little is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import pytest

from gdp.diagnosis.answer import Cause, Verdict
from gdp.diagnosis.diagnosis import RULES, diagnose
from gdp.diagnosis.facts import Facts, FlowFact, ProxyFacts, RibFacts, SwitchFacts, Unreachable, WaitFact
from gdp.diagnosis.survey import ROLES, Survey
from gdp.names import Name

NEAR, SWITCH, RIB, FAR = "1" * 64, "2" * 64, "3" * 64, "4" * 64
FLOW = FlowFact(
    side="import", kind="topic", local="/a", type_name="x/msg/X", overlay="5" * 64, is_carried=True, nodes=1,
    delegated="yes", advertised="accepted", writers=1, live=1, age_s=60.0,
)  # fmt: skip
PROXY = ProxyFacts(name=NEAR, is_near=True, switch=SWITCH, is_attached=True, uptime_s=60.0, entities=3, flows=(FLOW,))


def facts(*, flow: FlowFact = FLOW, **more: object) -> Facts:
    return Facts(asked="/a", proxies=(replace(PROXY, flows=(flow,)),), window_s=1.0, **more)  # type: ignore[arg-type]


def test_without_far_facts_an_unheard_topic_is_not_called_a_fault() -> None:
    answer = diagnose(facts())
    assert (answer.cause, answer.cause.verdict) == (Cause.UNKNOWN, Verdict.UNKNOWN)
    assert "no far proxy" in answer.sentence


def test_a_node_that_did_not_answer_is_listed() -> None:
    silent = Unreachable(role="switch", where="abc…def", why="no answer", is_down=False)
    assert diagnose(facts(unreachable=(silent,))).unknown == ("switch abc…def: no answer",)


def test_what_flows_is_never_a_fault() -> None:
    flow = replace(FLOW, received=10, idle_s=0.03, faults={"too-large": 3}, refused="quota")
    switch = SwitchFacts(name=SWITCH, is_near=True, drops={"too-big": 9})
    assert diagnose(facts(flow=flow, switches=(switch,))).cause is Cause.ARRIVES


@pytest.mark.parametrize("side", ["import", "expose"])
def test_the_reader_that_governs_a_topic_is_named_with_its_path(side: str) -> None:
    exposed = replace(FLOW, side="expose", sent=9, readers=2)
    exposed = replace(exposed, governing=FAR, governing_rtt_s=0.042, governing_bits_s=3.1e6)
    flows = (exposed,) if side == "expose" else (replace(FLOW, received=10, idle_s=0.03), exposed)
    answer = diagnose(Facts(asked="/a", proxies=(replace(PROXY, flows=flows),), window_s=1.0))
    assert answer.cause is Cause.ARRIVES
    named = f"the slowest reader, proxy {Name.from_text(FAR).short}, governs (round trip 42 ms, 3.1 Mbit/s)"
    assert named in answer.sentence


def test_the_servers_are_named_in_the_order_in_which_requests_go_to_them() -> None:
    flow = replace(
        FLOW, kind="service", connected=2, silent=1, ranking=("75e…0fc (cost 20)", "0a1…b2c (cost 0, silent)")
    )
    answer = diagnose(facts(flow=flow))
    assert answer.sentence.endswith("connected; requests go to 75e…0fc (cost 20), then 0a1…b2c (cost 0, silent).")


def test_messages_for_faster_readers_only_are_no_fault_and_the_switch_that_left_them_out_is_named() -> None:
    flow = replace(FLOW, received=10, idle_s=0.03, lost={"thinned": 30})
    switch = SwitchFacts(name=SWITCH, drops={"thinned": 31})
    answer = diagnose(facts(flow=flow, switches=(replace(switch, name=NEAR, is_near=True, drops={}), switch)))
    assert answer.cause is Cause.ARRIVES
    named = f"30 of 40 messages went to faster readers only, left out at switch {Name.from_text(SWITCH).short}"
    assert named in answer.sentence


EXPOSED: Final = replace(FLOW, side="expose", messages=8, sent=8, readers=1, mtu=1_500)


def between(exposed: FlowFact, imported: FlowFact = FLOW) -> Facts:
    """Return the facts of a topic's two ends: the reader is known, and got nothing just now."""
    far = replace(PROXY, name=FAR, is_near=False, flows=(exposed,))
    return Facts(asked="/a", proxies=(replace(PROXY, flows=(imported,)), far), window_s=1.0)


def test_frames_that_no_report_confirms_while_none_of_full_size_comes_show_a_narrow_link() -> None:
    answer = diagnose(between(replace(EXPOSED, is_unconfirmed=True)))
    assert answer.cause is Cause.MTU_HOLE
    assert "less than the 1500 bytes that it states" in answer.sentence


def test_a_queue_of_what_no_reader_gets_says_nothing_of_a_link() -> None:
    assert diagnose(between(EXPOSED)).cause is not Cause.MTU_HOLE  # all of it was older than the reader


def test_a_message_that_is_on_its_way_for_long_says_nothing_of_a_link() -> None:
    answer = diagnose(between(replace(EXPOSED, is_unconfirmed=True), replace(FLOW, full_parts=40)))
    assert answer.cause is Cause.ARRIVES
    assert "not complete yet" in answer.sentence


@pytest.mark.parametrize(("other", "cause"), [(SWITCH, Cause.ETHERTYPE_FILTERED), (RIB, Cause.LINK_SILENT)])
def test_a_filter_is_named_only_between_two_that_had_each_other_as_neighbours(other: str, cause: Cause) -> None:
    near = SwitchFacts(name=SWITCH, is_near=True, waits=(WaitFact(reason="no-neighbour", device="e0", neighbour=FAR),))
    far = SwitchFacts(name=FAR, waits=(WaitFact(reason="no-neighbour", device="e1", neighbour=other),))
    torn = replace(PROXY, is_attached=False)
    assert diagnose(Facts(asked="/a", proxies=(torn,), switches=(near, far), window_s=1.0)).cause is cause


def test_a_message_a_while_ago_is_idle() -> None:
    assert diagnose(facts(flow=replace(FLOW, idle_s=300.0))).cause is Cause.IDLE


def test_what_is_young_is_not_called_a_fault() -> None:
    young = replace(PROXY, uptime_s=1.0, is_attached=False)
    switch = SwitchFacts(name=SWITCH, is_near=True)
    assert diagnose(Facts(asked="/a", proxies=(young,), switches=(switch,))).cause is Cause.STARTING


def test_a_known_lack_is_a_fault_from_the_first_second() -> None:
    young = replace(PROXY, uptime_s=1.0, flows=(replace(FLOW, delegated="no", is_carried=False, live=0),))
    answer = diagnose(Facts(asked="/a", proxies=(young,)))
    assert answer.cause is Cause.DELEGATION_MISSING
    assert answer.command.startswith("gdp delegate name ")


@pytest.mark.parametrize(("cause", "rule"), RULES.items(), ids=lambda each: getattr(each, "value", ""))
def test_no_rule_fails_on_empty_facts(cause: Cause, rule: object) -> None:
    del rule
    answer = diagnose(Facts(asked="/a"))
    assert answer.cause is Cause.NO_PROXY_HERE
    assert cause.value


def test_the_json_form_names_all_parts() -> None:
    assert diagnose(Facts(asked="/a")).to_fields().keys() == {"verdict", "cause", "sentence", "command", "unknown"}


def test_a_survey_asks_each_node_once() -> None:
    survey = Survey("/a")
    survey.add("proxy", {"name": NEAR, "switch": SWITCH}, is_near=True)
    assert survey.targets(0) == [SWITCH]
    survey.add("switch", {"name": SWITCH, "rib": RIB, "reaches": [SWITCH], "proxies": [NEAR, FAR]}, is_near=True)
    assert [survey.targets(each) for each in range(len(ROLES))] == [[], [RIB], [], [FAR]]
    survey.add("rib", {"name": RIB, "routes": [{"advertiser": FAR, "right": "publish", "switch": "6" * 64}]})
    assert survey.targets(2) == ["6" * 64]
    survey.add("proxy", {"name": 7})
    assert "form" in survey.facts().unreachable[0].why
    assert survey.facts().ribs == (RibFacts(name=RIB, routes=survey.facts().ribs[0].routes),)
