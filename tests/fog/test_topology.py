"""Tree of gateways, as stated in ``fog.yaml``."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from fog.topology import AUTOMATIC, AUTOMATIC_REPLICA, Gateway, Topology

TREE = {
    "gateway": "edge",
    "children": [
        {"gateway": "west", "regions": ["us-west-1"], "children": [{"gateway": "far", "regions": ["ap-1"]}]},
        {"gateway": "east", "regions": ["us-east-1"]},
    ],
}


def test_each_gateway_comes_before_those_behind_it() -> None:
    assert [each.gateway for each in Gateway.model_validate(TREE).traverse()] == ["edge", "west", "far", "east"]


@pytest.mark.parametrize(("region", "gateway"), [("us-west-1", "west"), ("ap-1", "far"), ("mars-1", "edge")])
def test_a_region_is_served_by_the_gateway_that_names_it_or_by_the_first(region: str, gateway: str) -> None:
    assert Gateway.model_validate(TREE).serving(region).gateway == gateway


def test_without_a_topology_one_gateway_serves_all() -> None:
    assert list(AUTOMATIC.traverse()) == [AUTOMATIC.serving("anywhere")]


@pytest.mark.parametrize(
    ("tree", "why"),
    [
        ({"gateway": "a", "children": [{"gateway": "a"}]}, "gateway a stands twice"),
        ({"gateway": "a", "regions": ["x"], "children": [{"gateway": "b", "regions": ["x"]}]}, "region x stands twice"),
        ({"gateway": "Much too long"}, "pattern"),
        ({"gateway": "a", "children": [{"gateway": "b", "region": "x"}]}, "Extra inputs"),
        ({"gateway": "a", "children": [{"gateway": f"b{number}"} for number in range(64)]}, "at most 64"),
        ({"gateway": "a", "replica": True, "children": [{"gateway": "b", "regions": ["x"]}]}, "a is a replica and has"),
        ({"gateway": "a", "children": [{"gateway": "b", "replica": True}]}, "b is a replica without regions"),
        ({"gateway": "a", "replica": "perhaps"}, "valid boolean"),
        ({"gateway": "a", "replicas": True}, "Extra inputs"),
        ({"replica": True}, "Field required"),
        ({"gateway": {"replica": True, "regions": ["x"]}}, "valid string"),
        ("replicas", "expected the word 'replica', or a mapping"),
        (["replica"], "valid dictionary"),
    ],
)
def test_a_tree_that_cannot_be_is_refused(tree: object, why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        TypeAdapter(Topology).validate_python(tree)


def test_a_gateway_below_a_dedicated_one_may_be_a_replica() -> None:
    west = {"gateway": "west", "replica": True, "regions": ["us-west-1"]}
    tree = Gateway.model_validate({"gateway": "edge", "children": [west]})
    assert tree.serving("us-west-1").replica
    assert not tree.serving("mars-1").replica


def test_one_word_makes_the_only_gateway_a_replica() -> None:
    assert TypeAdapter(Topology).validate_python("replica") == AUTOMATIC_REPLICA
    assert AUTOMATIC_REPLICA.serving("anywhere").replica
