"""The tree of gateways, as ``fog.yaml`` states it."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from fog.topology import AUTOMATIC, Gateway

TREE = {
    "gateway": "edge",
    "children": [
        {"gateway": "west", "regions": ["us-west-1"], "children": [{"gateway": "far", "regions": ["ap-1"]}]},
        {"gateway": "east", "regions": ["us-east-1"]},
    ],
}


def test_each_gateway_comes_before_those_behind_it() -> None:
    assert [each.gateway for each in Gateway.model_validate(TREE).walk()] == ["edge", "west", "far", "east"]


@pytest.mark.parametrize(("region", "gateway"), [("us-west-1", "west"), ("ap-1", "far"), ("mars-1", "edge")])
def test_a_region_is_served_by_the_gateway_that_names_it_or_by_the_first(region: str, gateway: str) -> None:
    assert Gateway.model_validate(TREE).serving(region).gateway == gateway


def test_without_a_topology_one_gateway_serves_all() -> None:
    assert list(AUTOMATIC.walk()) == [AUTOMATIC.serving("anywhere")]


@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"gateway": "a", "children": [{"gateway": "a"}]}, "gateway a stands twice"),
        ({"gateway": "a", "regions": ["x"], "children": [{"gateway": "b", "regions": ["x"]}]}, "region x stands twice"),
        ({"gateway": "Much too long"}, "pattern"),
        ({"gateway": "a", "children": [{"gateway": "b", "region": "x"}]}, "Extra inputs"),
        ({"gateway": "a", "children": [{"gateway": f"b{number}"} for number in range(64)]}, "at most 64"),
    ],
)
def test_a_tree_that_cannot_be_is_refused(tree: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        Gateway.model_validate(tree)
