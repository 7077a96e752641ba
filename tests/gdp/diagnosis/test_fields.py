"""JSON form of facts: it comes back as it was, and a stranger's form is refused."""

from __future__ import annotations

import json

import pytest

from gdp.crypto.cbor import decode, encode
from gdp.diagnosis.facts import FlowFact, ProxyFacts, SwitchFacts, TunnelFact, WaitFact
from gdp.diagnosis.fields import ITEMS_MAX, from_fields, to_fields
from gdp.errors import DropReason, StatementError

FACTS = ProxyFacts(
    name="ab" * 32,
    unix_s=1.5,
    entities=0,
    waits=(WaitFact(reason="no-rib"),),
    flows=(FlowFact(side="import", kind="topic", local="/a", lost={"gap": 3}, idle_s=0.0, is_reliable=False),),
)


def test_facts_come_back_through_json_and_cbor() -> None:
    shown = to_fields(FACTS)
    assert from_fields(ProxyFacts, json.loads(json.dumps(shown))) == FACTS
    through = decode(encode(shown))
    assert isinstance(through, dict)
    assert from_fields(ProxyFacts, through) == FACTS


def test_defaults_take_no_bytes() -> None:
    assert to_fields(TunnelFact(peer="a")) == {"peer": "a"}


def test_an_unknown_key_is_ignored() -> None:
    assert from_fields(WaitFact, {"reason": "no-rib", "later": 1}) == WaitFact(reason="no-rib")


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"name": 1},
        {"name": "a", "waits": {}},
        {"name": "a", "waits": [1]},
        {"name": "a", "pending": True},
        {"name": "a", "drops": {"x": "y"}},
        {"name": "a", "neighbours": ["x"] * (ITEMS_MAX + 1)},
        {"name": "x" * 2_000},
    ],
)
def test_another_form_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(StatementError) as caught:
        from_fields(SwitchFacts, given)
    assert caught.value.reason is DropReason.MALFORMED


def test_counters_of_a_sample_are_those_since_the_one_before() -> None:
    flow = FlowFact(side="import", kind="topic", local="/a", received=7, lost={"gap": 5, "lifespan": 1})
    before = FlowFact(side="import", kind="topic", local="/a", received=4, lost={"gap": 5})
    since = flow.since(before)
    assert (since.received, since.lost) == (3, {"lifespan": 1})
