"""Fog actions with stand-ins of ROS 2's ``launch`` and ``launch_ros``, or the real packages (``ros2/README.md``)."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from fog.cluster import CloudNode, ClusterPlan, MachineRequest, RobotNode
from fog.hardware import Hardware
from fog.launch.lazy_names import has_ros_launch
from fog.launch.load import load
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
    if code := int(sys.argv[2]):
        sys.stderr.write("a word\\nerror: no machine is to be had\\n")
        sys.exit(code)
"""
CLUSTER = """FogCluster(
        cloud_nodes=[Node(package="p", executable="e", parameters=[{"size": 640, "rates": [1.0, 2.0]}])],
        deployments=[CloudMachine()],
        services={"/echo": "std_srvs/srv/SetBool"},
        keep=KEEP,
    )"""
FILE = """
from launch.actions import ExecuteProcess, GroupAction, OpaqueFunction
from fog import CloudMachine, FogCluster, LaunchDescription, Node

def generate_launch_description():
    robot = ExecuteProcess(cmd=["sh", "-c", "echo robot >> LOG"])
    BODY
"""


def launched(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    body: str = "return LaunchDescription([CLUSTER, robot])",
    *,
    code: int = 0,
    keep: bool = False,
) -> SimpleNamespace:
    """Launch a file in which a process appends a line, with a ``fog`` command that only records its calls."""
    launch, actions = importlib.import_module("launch"), importlib.import_module("launch.actions")
    sources = importlib.import_module("launch.launch_description_sources")
    log = folder / "log"
    script = written(folder, FOG, "fog.py")
    text = FILE.replace("BODY", body).replace("CLUSTER", CLUSTER).replace("KEEP", str(keep)).replace("LOG", str(log))
    path = written(folder, text)
    monkeypatch.setattr(importlib.import_module("gdp.host.run_registry"), "_default_directory", lambda: folder / "runs")
    action = importlib.import_module("fog.launch.ros_action")
    monkeypatch.setattr(action, "FOG", (sys.executable, str(script), str(log), str(code)))
    service = launch.LaunchService(noninteractive=True)
    source = sources.PythonLaunchDescriptionSource(str(path))
    service.include_launch_description(launch.LaunchDescription([actions.IncludeLaunchDescription(source)]))
    exit_code = service.run()
    lines = [line.split()[0] for line in log.read_text().splitlines()] if log.exists() else []
    plan = Path(f"{log}.plan")
    left = list((folder / "runs").iterdir()) if (folder / "runs").exists() else []
    return SimpleNamespace(
        lines=lines,
        code=exit_code,
        plan=ClusterPlan.from_json(plan.read_text()) if plan.exists() else None,
        left=left,
    )


def test_the_robots_nodes_start_when_the_cluster_serves_and_it_ends_with_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    reported = launched(monkeypatch, tmp_path)
    assert reported.lines == ["launch", "robot", "down"]
    assert (reported.code, reported.left) == (0, [])


def test_lists_of_parameters_reach_the_cloud(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    words = launched(monkeypatch, tmp_path).plan.nodes[0].arguments
    assert words[0] == "--ros-args"
    assert {*words[1:]} == {"-p", "size:=640", "rates:=[1.0, 2.0]"}


def test_a_kept_cluster_outlives_its_launch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert launched(monkeypatch, tmp_path, keep=True).lines == ["launch", "robot"]


def test_a_cluster_that_does_not_start_ends_the_launch_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    reported = launched(monkeypatch, tmp_path, code=3)
    assert (reported.lines, reported.code) == (["launch", "down"], 1)
    said = "".join(capfd.readouterr())
    assert "[launch]: Caught exception in launch" in said
    assert "cluster e did not start: no machine is to be had" in said


@pytest.mark.parametrize(
    "body",
    [
        "CLUSTER; return LaunchDescription([robot])",
        "cluster = CLUSTER; return LaunchDescription([robot])",
        "global kept; kept = CLUSTER; return LaunchDescription([robot])",
    ],
    ids=["neither assigned nor returned", "assigned", "assigned to the module"],
)
def test_a_cluster_that_is_not_returned_starts_before_the_robots_nodes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: str
) -> None:
    assert launched(monkeypatch, tmp_path, body).lines == ["launch", "robot", "down"]


def test_a_cluster_that_something_else_is_to_launch_is_left_to_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    body = "cluster = CLUSTER; return LaunchDescription([robot, OpaqueFunction(function=lambda _: [cluster])])"
    reported = launched(monkeypatch, tmp_path, body)
    assert (sorted(reported.lines), reported.code) == (["down", "launch", "robot"], 0)


def test_a_second_launch_file_of_the_same_process_is_watched_as_well(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        (folder := tmp_path / name).mkdir()
        reported = launched(monkeypatch, folder, "CLUSTER; return LaunchDescription([robot])")
        assert reported.lines == ["launch", "robot", "down"]


def test_a_launch_file_that_imports_too_late_to_be_watched_is_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    launch, actions = importlib.import_module("launch"), importlib.import_module("launch.actions")
    sources = importlib.import_module("launch.launch_description_sources")
    text = "def generate_launch_description():\n    from fog import CloudMachine, FogCluster, LaunchDescription, Node\n"
    text += f"    {CLUSTER.replace('KEEP', 'False')}\n    return LaunchDescription([])\n"
    service = launch.LaunchService(noninteractive=True)
    source = sources.PythonLaunchDescriptionSource(str(written(tmp_path, text)))
    service.include_launch_description(launch.LaunchDescription([actions.IncludeLaunchDescription(source)]))
    assert service.run() == 1
    assert "import fog at the top of the file" in "".join(capfd.readouterr())


def test_a_cluster_in_a_scoped_group_holds_what_comes_after_the_group(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    body = "return LaunchDescription([GroupAction([GroupAction([CLUSTER])]), robot])"
    assert launched(monkeypatch, tmp_path, body).lines == ["launch", "robot", "down"]


def test_a_python_module_runs_as_a_node_under_its_own_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my.robot").mkdir()
    package = tmp_path / "code" / "robot_code"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "nodes").mkdir()
    (package / "nodes" / "__init__.py").touch()
    (package / "nodes" / "client.py").write_text(f"open({str(tmp_path / 'log')!r}, 'a').write('module\\n')\n")
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(package.parent), *sys.path]))
    body = 'return LaunchDescription([CLUSTER, Node(package="robot_code.nodes", executable="client")])'
    assert launched(monkeypatch, tmp_path, body).lines == ["launch", "module", "down"]
    assert "[client-1]" in "".join(capfd.readouterr())


def test_the_first_listing_means_the_same_with_ros_2_installed(tmp_path: Path) -> None:
    assert has_ros_launch()
    loaded = load(written(tmp_path, LISTING), {})
    assert loaded.plan.nodes == (CloudNode("detection", "detector"),)
    assert loaded.plan.machines[1] == MachineRequest(Hardware(gpu="T4", gpus=1), "us-east-1", is_spot=True)
    assert loaded.robot_nodes == (RobotNode(CloudNode("robot", "robot_client"), "log"),)


def test_arguments_parameters_and_remappings_mean_the_same_with_ros_2_installed(tmp_path: Path) -> None:
    file = written(tmp_path, "n: {ros__parameters: {depth: 4}}\nb/n: {ros__parameters: {depth: 3}}", "p.yaml")
    text = WITH_ARGUMENTS.replace("PARAMETERS", str(file)).replace('"rate": rate, ', "")
    words = load(written(tmp_path, text), {"where": "b"}).plan.nodes[0].arguments
    assert words == (
        *("-v", "--ros-args", "-r", "__node:=n", "-r", "__ns:=/b"),
        *("-p", "deep.rates:=[1, 2]", "-p", "depth:=3", "-r", "in:=/out"),
    )


def test_where_a_robots_node_prints_is_kept(tmp_path: Path) -> None:
    nodes = [f'Node(package="r", executable="{word}", output="{word}")' for word in ("log", "screen", "both")]
    loaded = gathered(tmp_path, f"cluster, {', '.join(nodes)}")
    assert [each.output for each in loaded.robot_nodes] == ["log", "screen", "screen"]


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
        ("cluster, DeclareLaunchArgument('rate')", "launch argument .rate. was not provided"),
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
