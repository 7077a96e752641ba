"""One tree of transforms at a station, from robots whose frames have the same names."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest
from rosbags.typesys import Stores, get_typestore

from proxy.endpoints.core.qos import DEPTH_MAX, default
from tests.proxy.bridge.known import TRANSFORMS
from tests.proxy.bridge.sites import SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import Publication

ROBOTS: Final = ("robot1", "robot2", "robot3")
STATIC: Final = ("base_link>camera", "base_link>lidar", "camera>optical")
KEPT: Final = default(latched=True, depth=1)
_STORE: Final = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def transforms(*pairs: str, at: tuple[float, float] = (0.0, 0.0)) -> bytes:
    """Return the transforms of pairs, each as parent>child, and all at one place in x and y."""
    types = _STORE.types
    place = types["geometry_msgs/msg/Vector3"](*at, 0.0)
    pose = types["geometry_msgs/msg/Transform"](place, types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    listed = [
        types["geometry_msgs/msg/TransformStamped"](types["std_msgs/msg/Header"](stamp, parent), child, pose)
        for parent, child in (pair.split(">") for pair in pairs)
    ]
    return bytes(_STORE.serialize_cdr(types[TRANSFORMS](listed), TRANSFORMS))


def placed(ear: Ear) -> list[tuple[str, float, float]]:
    """Return the pairs in all messages, and the place of each in x and y."""
    messages: list[Any] = [_STORE.deserialize_cdr(raw, TRANSFORMS) for raw in ear.heard]
    return [
        (f"{each.header.frame_id}>{each.child_frame_id}", each.transform.translation.x, each.transform.translation.y)
        for message in messages
        for each in message.transforms
    ]


def pairs_of(ear: Ear) -> list[str]:
    """Return the pairs in all messages."""
    return [pair for pair, _, _ in placed(ear)]


def _has(ear: Ear, pairs: list[str]) -> bool:
    return sorted(pairs_of(ear)) == pairs


def rule(topic: str, robot: str, more: str = "") -> str:
    return f"name: {topic}, type: {TRANSFORMS}, prefix: {robot}{more}"


def renamed(topic: str, robot: str) -> str:
    return rule(topic, robot, f", frames: {{add: {robot}/, common: [map]}}")


def fleet(sites: Sites) -> dict[str, Publication]:
    """Start the robots with their static publishers; return those of the moving frames."""
    moving = {}
    for robot in ROBOTS:
        machine = sites.add(f"nuc1/{robot}", expose=[rule("/tf", robot), rule("/tf_static", robot)])
        for number, pair in enumerate(STATIC):
            machine.graph.publish(f"/static{number}", "/tf_static", TRANSFORMS, KEPT).publish(transforms(pair))
        moving[robot] = machine.graph.publish("/localizer", "/tf", TRANSFORMS)
    return moving


def station(sites: Sites) -> Machine:
    return sites.add(SERVER, imports=[renamed(topic, robot) for topic in ("/tf", "/tf_static") for robot in ROBOTS])


def test_a_late_reader_gets_the_static_frames_of_every_publisher_of_every_robot_once(sites: Sites) -> None:
    fleet(sites)
    server = station(sites)
    early = Ear(server.graph, "/tf_static", TRANSFORMS, qos=default(latched=True, depth=100))
    want = sorted(f"{robot}/{pair.replace('>', f'>{robot}/')}" for robot in ROBOTS for pair in STATIC)
    assert sites.run(5, lambda: sorted(pairs_of(early)) == want)
    sites.run(30)
    late = Ear(server.graph, "/tf_static", TRANSFORMS, qos=default(latched=True, depth=100), node="/late")
    assert sites.run(5, lambda: len(pairs_of(late)) >= len(want))
    sites.run(5)
    assert sorted(pairs_of(late)) == want
    assert sorted(pairs_of(early)) == want
    assert server.faults == {}


def test_a_robot_may_have_more_static_publishers_than_messages_are_kept_of_one(sites: Sites) -> None:
    count = DEPTH_MAX + 30
    robot = sites.add("nuc1/robot1", expose=[rule("/tf_static", "robot1")])
    for number in range(count):
        robot.graph.publish(f"/static{number}", "/tf_static", TRANSFORMS, KEPT).publish(transforms(f"base>{number}"))
    server = sites.add(SERVER, imports=[renamed("/tf_static", "robot1")])
    want = sorted(f"robot1/base>robot1/{number}" for number in range(count))
    for node in ("/early", "/late"):
        ear = Ear(server.graph, "/tf_static", TRANSFORMS, qos=default(latched=True, depth=1_000), node=node)
        assert sites.run(10, partial(_has, ear, want))
        sites.run(5)
        assert _has(ear, want)


def test_moving_frames_of_equal_names_do_not_mix_and_the_common_one_joins_them(sites: Sites) -> None:
    moving, server = fleet(sites), station(sites)
    ear = Ear(server.graph, "/tf", TRANSFORMS)
    robots = [machine for machine in sites.machines if machine is not server]
    assert sites.run(5, lambda: all(len(list(robot.member.publications)) == 2 for robot in robots))
    sites.run(2)
    for robot in ROBOTS:
        sites.every(0.02, 50, partial(_move, moving[robot]))
    sites.run(5)
    want = [pair for robot in ROBOTS for pair in (f"map>{robot}/odom", f"{robot}/odom>{robot}/base_link")]
    assert sorted(pairs_of(ear)) == sorted(want * 50)


def _move(publication: Publication, number: int) -> None:
    del number
    publication.publish(transforms("map>odom", "odom>base_link"))


def test_a_command_in_a_frame_of_the_station_comes_in_the_robots_own(sites: Sites) -> None:
    server = sites.add(SERVER, expose=[rule("/goal", "robot1")])
    robot = sites.add("nuc1/robot1", imports=[rule("/goal", "robot1", ", frames: {remove: robot1/}")])
    ear, operator = Ear(robot.graph, "/goal", TRANSFORMS), server.graph.publish("/rviz", "/goal", TRANSFORMS)
    assert sites.run(3, server.is_read)
    operator.publish(transforms("map>robot1/goal"))
    assert sites.run(1, lambda: pairs_of(ear) == ["map>goal"])
