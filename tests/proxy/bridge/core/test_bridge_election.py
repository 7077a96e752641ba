"""Election of the proxy that carries a name where several proxies see one ROS graph."""

from __future__ import annotations

import pytest

from proxy.bridge.core.bridge_election import BridgeElection, attributed, presence_of_node
from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role, proxy_node_name

FIRST, SECOND, THIRD = (proxy_node_name(digit * 12) for digit in "123")
SCAN = "/scan"


def entity(node: str, name: str, role: Role = Role.PUBLISHES) -> GraphEntity:
    return GraphEntity(role, name, "sensor_msgs/msg/LaserScan", node, f"{node}{name}")


def graph(*carried: tuple[str, str]) -> Graph:
    """Return a graph in which these nodes publish these topics; nodes have names with a namespace."""
    return frozenset(entity(f"/{node}", name) for node, name in carried)


@pytest.mark.parametrize(("me", "rank"), [(FIRST, 0), (SECOND, 1), (THIRD, 2)], ids=["first", "second", "third"])
def test_proxies_wait_by_their_rank_and_the_first_begins_at_once(me: str, rank: int) -> None:
    others = graph(*((each, "/tf") for each in (FIRST, SECOND, THIRD)), ("camera", SCAN))
    step_s = BridgeElection(SECOND, others).patience_s
    assert step_s > 0
    assert BridgeElection(me, others).patience_s == pytest.approx(rank * step_s)


def test_no_proxy_begins_a_name_that_another_one_carries() -> None:
    election = BridgeElection(FIRST, graph((THIRD, SCAN), (SECOND, SCAN), (FIRST, SCAN), ("lidar", SCAN)))
    assert election.before_us(SCAN, is_begun=False) == SECOND
    assert election.before_us("/tf", is_begun=False) == ""


@pytest.mark.parametrize(("me", "conflict"), [(FIRST, ""), (SECOND, FIRST), (THIRD, FIRST)])
def test_of_proxies_that_have_begun_the_first_one_goes_on(me: str, conflict: str) -> None:
    carried = graph(*((each, SCAN) for each in (FIRST, SECOND, THIRD)))
    assert BridgeElection(me, carried).before_us(SCAN, is_begun=True) == conflict


def test_a_proxy_that_only_calls_a_service_does_not_carry_it() -> None:
    caller = frozenset({entity(f"/{SECOND}", "/fold", Role.CALLS)})
    assert BridgeElection(FIRST, caller).before_us("/fold", is_begun=False) == ""


def test_what_a_far_node_offers_counts_as_its_proxys() -> None:
    shown, scan = entity(f"/{SECOND}", presence_of_node("/arm")), entity("/arm", SCAN)
    assert {end.node for end in attributed(frozenset({shown, scan}))} == {f"/{SECOND}"}
    assert attributed(frozenset({scan})) == {scan}
