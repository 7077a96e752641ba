"""Against stand-ins of ROS 2's ``launch`` and ``launch_ros`` (``ros2/README.md``)."""

from __future__ import annotations

import asyncio
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from fog.cluster import CloudNode, ClusterPlan, Wanted
from fog.hardware import Hardware
from fog.launch.load import RobotNode, load
from fog.launch.words import has_ros_launch
from gdp.errors import LocalError
from tests.fog.launch.test_load import LISTING, WITH_ARGUMENTS, written

if TYPE_CHECKING:
    from fog.launch.load import Loaded

pytestmark = pytest.mark.usefixtures("ros2")

ROS = """
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, GroupAction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from fog import CloudMachine, FogCluster

class Never:
    def evaluate(self, context):
        return False

def generate_launch_description():
    cluster = FogCluster(cloud_nodes=[Node(package="p", executable="e")], deployments=[CloudMachine()], services={})
    return LaunchDescription([%s])
"""
FOG = """
import json, pathlib, sys
with open(sys.argv[1], "a") as log:
    log.write(" ".join(sys.argv[3:]).replace("\\\\", "/") + "\\n")
if sys.argv[3] == "launch":
    pathlib.Path(sys.argv[1] + ".plan").write_text(pathlib.Path(sys.argv[4]).read_text())
    sys.exit(int(sys.argv[2]))
"""


def launched(monkeypatch: pytest.MonkeyPatch, folder: Path, *, code: int = 0, keep: bool = False) -> SimpleNamespace:
    """Launch a cluster and a process that appends a line, with a ``fog`` command that only takes notes."""
    launch, actions = importlib.import_module("launch"), importlib.import_module("launch.actions")
    action, node = importlib.import_module("fog.launch.ros_action"), importlib.import_module("launch_ros.actions")
    log = folder / "log"
    script = written(folder, FOG, "fog.py")
    monkeypatch.setattr(action, "FOG", (sys.executable, str(script), str(log), str(code)))
    monkeypatch.setattr(importlib.import_module("gdp.testbed.runs"), "_default_directory", lambda: folder / "runs")
    cluster = action.FogCluster(
        cloud_nodes=[node.Node(package="p", executable="e", parameters=[{"size": 640}])],
        deployments=[sys.modules["fog.launch.machines"].CloudMachine()],
        services={"/echo": "std_srvs/srv/SetBool"},
        keep=keep,
    )
    robot = actions.ExecuteProcess(cmd=["sh", "-c", f"echo robot >> {log}"])
    service = launch.LaunchService()
    asyncio.run(service.run_async(launch.LaunchDescription([cluster, robot])))
    lines = [line.split()[0] for line in log.read_text().splitlines()]
    plan = ClusterPlan.from_json(Path(f"{log}.plan").read_text())
    return SimpleNamespace(lines=lines, reason=service.reason, plan=plan, left=list((folder / "runs").iterdir()))


def test_the_robots_nodes_start_when_the_cluster_serves_and_it_ends_with_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    told = launched(monkeypatch, tmp_path)
    assert told.lines == ["launch", "robot", "down"]
    assert told.plan.nodes == (CloudNode("p", "e", ("--ros-args", "-p", "size:=640")),)
    assert told.left == []


def test_a_kept_cluster_outlives_its_launch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert launched(monkeypatch, tmp_path, keep=True).lines == ["launch", "robot"]


def test_a_cluster_that_does_not_start_ends_the_launch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told = launched(monkeypatch, tmp_path, code=3)
    assert told.lines == ["launch", "down"]
    assert told.reason == "fog: cluster e did not start (exit 3)"


def test_the_first_listing_means_the_same_with_ros_2_installed(tmp_path: Path) -> None:
    assert has_ros_launch()
    loaded = load(written(tmp_path, LISTING), {})
    assert loaded.plan.nodes == (CloudNode("detection", "detector"),)
    assert loaded.plan.machines[1] == Wanted(Hardware(gpu="T4", gpus=1), "us-east-1", is_spot=True)
    assert loaded.robot_nodes == (RobotNode(CloudNode("robot", "robot_client")),)


def test_arguments_parameters_and_remappings_mean_the_same_with_ros_2_installed(tmp_path: Path) -> None:
    file = written(tmp_path, "n: {ros__parameters: {depth: 4}}\nb/n: {ros__parameters: {depth: 3}}", "p.yaml")
    text = WITH_ARGUMENTS.replace("PARAMETERS", str(file)).replace('"rate": rate, ', "")
    words = load(written(tmp_path, text), {"where": "b"}).plan.nodes[0].arguments
    assert words == (
        *("-v", "--ros-args", "-r", "__node:=n", "-r", "__ns:=/b"),
        *("-p", "deep.rates:=[1, 2]", "-p", "depth:=3", "-r", "in:=/out"),
    )


def gathered(folder: Path, entities: str) -> Loaded:
    return load(written(folder, ROS % entities), {})


def test_groups_are_followed_and_conditions_heeded(tmp_path: Path) -> None:
    robot = 'Node(package="r", executable="{}", condition={})'
    loaded = gathered(tmp_path, f"cluster, GroupAction([{robot.format('on', None)}]), {robot.format('off', 'Never()')}")
    assert [each.node.executable for each in loaded.robot_nodes] == ["on"]


@pytest.mark.parametrize(
    ("entities", "says"),
    [
        ("cluster, ExecuteProcess(cmd=['true'])", "run it with ros2 launch"),
        ("cluster, DeclareLaunchArgument('rate')", "'rate' was not provided"),
        ("cluster, Node(executable='e')", "with a package"),
    ],
)
def test_what_only_ros_2_can_launch_is_refused(tmp_path: Path, entities: str, says: str) -> None:
    with pytest.raises(LocalError, match=says):
        gathered(tmp_path, entities)


def test_an_unrelated_package_called_launch_does_not_count(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "launch").mkdir()
    (tmp_path / "launch" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    assert not has_ros_launch()
