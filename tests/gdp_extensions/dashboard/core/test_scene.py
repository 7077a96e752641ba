"""Scene of the live view: what readings become, rates, events and history."""

from __future__ import annotations

import json
from typing import Any

from gdp_extensions.dashboard.core.graph import merge_readings
from gdp_extensions.dashboard.core.readings import Reading
from gdp_extensions.dashboard.core.scene import Scene
from gdp_extensions.dashboard.core.series import SAMPLES, SeriesStore
from tests.gdp_extensions.dashboard.synthetic_nodes import SyntheticNetwork


def switch(node: str, *links: dict[str, object], **more: object) -> Reading:
    """Return the reading of a switch."""
    fields = {"role": "switch", "id": node, "label": node, "domain": "d", "domain_label": "lab", "links": list(links)}
    return Reading({**fields, **more})


def link(other: str, bytes_out: int = 0, bytes_in: int = 0, **more: object) -> dict[str, object]:
    """Return one link of a switch."""
    return {"port": f"to-{other}", "to": other, "role": "switch", "bytes_out": bytes_out, "bytes_in": bytes_in, **more}


def texts(scene: Scene) -> list[object]:
    """Return the texts of all events."""
    events: Any = scene.figures(0)["events"]
    return [each["text"] for each in events]


def test_two_ends_make_one_link_with_the_rate_of_each_direction() -> None:
    scene = Scene()
    for at in range(2):
        rates = 1_000 * at, 400 * at
        scene.update(
            [switch("a", link("b", *rates, rtt_ms=0.5)), switch("b", link("a", *rates[::-1], rtt_ms=0.4))], at, at
        )
    figures: Any = scene.figures(0)
    assert figures["links"] == [[1_000.0, 400.0, 0.4, 0.0]]


def test_the_rate_of_a_slow_name_is_its_mean_over_some_seconds() -> None:
    scene = Scene()
    seen = []
    for poll in range(24):
        now_s = 0.75 * poll
        scene.update([switch("a", link("b", 100 * int(now_s)))], now_s, now_s)  # 100 bytes, once a second
        figures: Any = scene.figures(0)
        seen.append(figures["links"][0][0])
    assert all(70 <= each <= 130 for each in seen[8:])


def test_a_restarted_node_shows_no_negative_rate() -> None:
    scene = Scene()
    for at, count in enumerate((5_000, 10)):
        scene.update([switch("a", link("b", count))], at, at)
    figures: Any = scene.figures(0)
    assert figures["links"][0][:2] == [0.0, 0.0]


def test_switches_of_other_machines_come_from_link_states() -> None:
    topology = {"switches": [["a", "d", [["b", "d", 10]]], ["b", "d", [["a", "d", 10], ["c", "e", 10]]]]}
    graph = merge_readings([Reading(switch("a").fields, topology)])
    assert {each.id: each.is_near for each in graph.nodes.values()} == {"a": True, "b": False, "c": False}
    assert sorted(graph.links) == [("a", "b"), ("b", "c")]


def test_a_name_has_its_ends_its_local_name_and_its_tree() -> None:
    row = ["n1", "p", 1, "", ["b"]]
    proxy = {"role": "proxy", "id": "p", "names": [["n1", "publish", ""], ["n2", "read", "revoked"]]}
    flow = {"name": "n1", "local": "/scan", "type": "sensor_msgs/msg/LaserScan", "kind": "topic"}
    readings = [switch("a", names=[["n1", "q", "read"]], trees=[row]), Reading({**proxy, "flows": [flow]})]
    (name,) = merge_readings(readings).names.values()
    assert (name.label, name.publishers, name.readers) == ("/scan", {"p"}, {"q"})
    assert name.trees == [("p", 1, "a", "", ("b",))]


def test_first_answers_are_counted_by_server() -> None:
    servers = [{"id": "s1", "is_there": True, "first": 7}, {"id": "s2", "is_there": False, "first": 2}]
    flow = {"name": "n", "local": "/plan", "kind": "service", "servers": servers}
    graph = merge_readings([Reading({"role": "proxy", "id": "p", "flows": [flow]})])
    assert [(each.server, each.is_there, each.first) for each in graph.replicas] == [("s1", True, 7), ("s2", False, 2)]


def test_what_comes_and_goes_is_an_event_once() -> None:
    scene = Scene()
    both = [switch("a", link("b")), switch("b", link("a"))]
    for at, readings in enumerate((both[:1], both, both, [switch("a")])):
        scene.update(readings, at, at)
    begun = ["switch b answers again", "switch b is gone", "link switch a – switch b is lost"]
    assert texts(scene) == begun
    scene.update(both, 5, 5)
    assert texts(scene)[3:] == ["switch b is up", "link switch a – switch b is up"]


def test_who_gets_the_control_of_a_topic_is_an_event() -> None:
    scene = Scene()
    flow = {"name": "n1", "local": "/cmd_vel", "kind": "topic"}
    robot = {"role": "proxy", "id": "r", "label": "robot"}
    desk = Reading({"role": "proxy", "id": "d", "label": "desk"})
    for at, holder in enumerate(("", "", "d", "d")):
        scene.update([desk, Reading({**robot, "flows": [{**flow, "holder": holder}]})], at, at)
    assert texts(scene) == ["proxy desk controls /cmd_vel"]
    structure: Any = scene.structure()
    assert structure["names"][0][-1] == [0]


def test_many_names_at_once_are_one_event() -> None:
    scene = Scene()
    scene.update([switch("a")], 0, 0)
    scene.update([switch("a", names=[[f"n{each}", "p", "publish"] for each in range(500)])], 1, 1)
    assert [each for each in texts(scene) if "names" in str(each)] == ["500 names: each is used"]


def test_drops_are_an_event_at_most_every_ten_seconds() -> None:
    scene = Scene()
    for at in range(20):
        scene.update([switch("a", drops={"no-route": at})], at, at)
    assert texts(scene) == ["switch a drops: no-route, 1 so far", "switch a drops: no-route, 11 so far"]


def test_events_of_a_cluster_appear_once() -> None:
    scene = Scene()
    event = {"unix_s": 5.0, "cluster": "c", "text": "c m1: preempted"}
    supervisor = Reading({"role": "supervisor", "clusters": [{"name": "c"}], "events": [event]})
    for at in range(3):
        scene.update([supervisor], at, 10 + at)
    assert texts(scene) == ["c m1: preempted"]
    structure: Any = scene.structure()
    assert structure["clusters"] == [{"name": "c"}]


def test_figures_change_nothing_of_the_structure() -> None:
    scene, network = Scene(), SyntheticNetwork(6, 8, 100)
    for at in range(5):
        network.begun_s -= 10.0
        scene.update([Reading(each.snapshot()) for each in network.snapshots().values()], at, at)
    assert scene.version == 1
    assert json.loads(json.dumps(scene.figures(0)))["names"]


def test_fields_of_the_wrong_form_count_as_absent() -> None:
    wrong = {
        "role": "switch",
        "id": "a",
        "links": 7,
        "names": [["n"], 3],
        "trees": "x",
        "drops": [],
        "flows": [{}, None],
    }
    graph = merge_readings([Reading(wrong), Reading({"role": 4, "id": []}, {"switches": [[1, 2, 3]]})])
    assert (len(graph.links), graph.drops) == (0, {})


def test_history_keeps_fifteen_minutes() -> None:
    store = SeriesStore()
    for at in range(SAMPLES + 50):
        store.add({"a": float(at)})
    assert (len(store.samples("a")), store.samples("a")[0], store.samples("a")[-1]) == (SAMPLES, 50.0, SAMPLES + 49.0)


def test_a_series_of_zeros_takes_no_memory() -> None:
    store = SeriesStore()
    store.add({"idle": 0.0, "busy": 1.0})
    assert (len(store), store.samples("idle")) == (1, [0.0])
