"""Cluster specification of a launch: names, keys, services and refusals."""

import pytest

from fog.cluster import CloudNode, ClusterPlan, ExportedInterface
from fog.launch.entity import FogCluster
from fog.launch.machines import CloudMachine
from gdp.errors import LocalError
from gdp.service.replication import Mode, Replication

NODE = CloudNode("detection", "object_detector")


def cluster(**keywords: object) -> FogCluster:
    return FogCluster(**{"cloud_nodes": [NODE], "deployments": [CloudMachine()], **keywords})  # type: ignore[arg-type]


def test_a_cluster_is_called_after_its_first_node() -> None:
    assert cluster().cluster_spec.plan([NODE]).name == "object-detector"


def test_a_plan_survives_its_journal() -> None:
    plan = cluster(services={"/plan": "nav_msgs/srv/GetPlan"}, idle="30min", budget_usd=5).cluster_spec.plan([NODE])
    assert ClusterPlan.from_json(plan.to_json()) == plan
    assert (plan.idle_s, plan.budget_usd) == (1800.0, 5.0)


def test_keys_for_all_go_where_they_mean_something() -> None:
    cluster_spec = cluster(
        services={"/plan": {"type": "nav_msgs/srv/GetPlan", "stop": "/plan/stop", "at_once": 1, "timeout_s": 60}},
        actions={"/fold": "test_msgs/action/Fibonacci"},
        topics={"/map": "nav_msgs/msg/OccupancyGrid"},
        replication="hedged",
        timeout_s=2,
    ).cluster_spec
    hedged = {"mode": "hedged"}
    assert cluster_spec.carried == (
        ExportedInterface(
            "service",
            "/plan",
            "nav_msgs/srv/GetPlan",
            {"replication": hedged, "timeout_s": 60},
            {"at_once": 1, "stop": "/plan/stop"},
        ),
        ExportedInterface("action", "/fold", "test_msgs/action/Fibonacci", {"replication": hedged, "timeout_s": 2.0}),
        ExportedInterface("topic", "/map", "nav_msgs/msg/OccupancyGrid"),
    )


def test_a_service_that_keeps_state_says_so_on_both_sides_and_is_asked_in_one_way() -> None:
    counter = {"type": "std_srvs/srv/SetBool", "state": "ordered", "state_node": "/counter"}
    (carried,) = cluster(services={"/count": counter}, replication="hedged").cluster_spec.carried or ()
    assert carried.options == {"state": "ordered"}
    assert carried.served == {"state": "ordered", "state_node": "/counter"}


def test_send_options_of_a_topic_are_for_the_machine_that_publishes_it() -> None:
    topic = {"type": "nav_msgs/msg/OccupancyGrid", "deadline_ms": 500, "repair": "never", "weight": 3}
    (carried,) = cluster(topics={"/map": topic}).cluster_spec.carried or ()
    assert carried.options == {"weight": 3}
    assert carried.served == {"deadline_ms": 500, "repair": "never", "weight": 3}


def test_a_service_without_signatures_says_so_on_both_sides() -> None:
    offered = {"/plan": {"type": "nav_msgs/srv/GetPlan", "sign": "session"}}
    (carried,) = cluster(services=offered).cluster_spec.carried or ()
    assert carried.options["sign"] == carried.served["sign"] == "session"


def test_what_is_found_out_gets_the_keys_for_all() -> None:
    cluster_spec = cluster(replication=Replication(Mode.SOME, copies=2)).cluster_spec
    assert cluster_spec.carried is None
    assert cluster_spec.carry([("service", "/echo", "std_srvs/srv/SetBool")]) == (
        ExportedInterface("service", "/echo", "std_srvs/srv/SetBool", {"replication": {"mode": "some", "copies": 2}}),
    )


@pytest.mark.parametrize(
    ("keywords", "says"),
    [
        ({"name": "Über"}, "name 'Über'"),
        ({"services": {"plan": "nav_msgs/srv/GetPlan"}}, "full name"),
        ({"services": {"/plan": "nav_msgs/msg/Path"}}, "expected one such as nav_msgs/srv/GetPlan"),
        ({"services": {"/plan": {"type": "nav_msgs/srv/GetPlan", "stpo": "/x"}}}, "stpo: expected type"),
        ({"services": {"/plan": {"type": "nav_msgs/srv/GetPlan", "stop": "/stop"}}}, 'stop goes with "at_once": 1'),
        ({"replication": "twice"}, "expected all, some, hedged, nearest"),
        ({"replication": {"mode": "all", "copy": 2}}, "copy: expected mode"),
        ({"timeout_s": 0}, "timeout_s=0"),
        ({"idle": "soon"}, "span of time"),
        ({"budget_usd": -1}, "budget_usd=-1"),
    ],
)
def test_a_wrong_keyword_is_named(keywords: dict[str, object], says: str) -> None:
    with pytest.raises(LocalError, match=says):
        cluster(**keywords)


def test_a_cluster_without_nodes_is_refused() -> None:
    with pytest.raises(LocalError, match="cloud_nodes is empty"):
        cluster().cluster_spec.plan([])
