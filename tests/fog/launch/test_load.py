"""Launch files with Fog actions: loaded nodes, arguments, and errors with positions."""

import subprocess
import sys
from pathlib import Path

import pytest

from fog.cluster import CloudNode, ExportedInterface, MachineRequest, RobotNode
from fog.hardware import Hardware
from fog.launch.load import key_values, load
from gdp.errors import ConfigError, LocalError

LISTING = """
from fog import CloudMachine, FogCluster, LaunchDescription, Node, SpotMachine

def generate_launch_description():
    detector = Node(package="detection", executable="detector")
    cluster = FogCluster(
        cloud_nodes=[detector],
        deployments=[
            CloudMachine(region="us-west-1", hardware="cpu:16"),
            SpotMachine(region="us-east-1", hardware="T4"),
        ],
    )
    return LaunchDescription([cluster, Node(package="robot", executable="robot_client")])
"""
WITH_ARGUMENTS = """
from fog import *

def generate_launch_description():
    rate = LaunchConfiguration("rate")
    node = Node(
        package="p",
        executable="e",
        name="n",
        namespace=["/", LaunchConfiguration("where")],
        parameters=[{"rate": rate, "deep": {"rates": [1, 2]}}, "PARAMETERS"],
        remappings=[("in", "/out")],
        arguments=["-v"],
    )
    return LaunchDescription([
        DeclareLaunchArgument("rate", default_value="20"),
        DeclareLaunchArgument("where", choices=["a", "b"]),
        FogCluster(cloud_nodes=[node], deployments=[CloudMachine()], services={}, keep=True),
    ])
"""


def written(folder: Path, text: str, name: str = "x.launch.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_the_first_listing_of_the_paper_runs(tmp_path: Path) -> None:
    asked = []

    def probe(nodes: object) -> list[tuple[str, str, str]]:
        asked.append(nodes)
        return [("service", "/detect", "std_srvs/srv/SetBool")]

    loaded = load(written(tmp_path, LISTING), {}, probe)
    detector = CloudNode("detection", "detector")
    assert asked == [(detector,)] or asked == [[detector]]
    assert loaded.plan.nodes == (detector,)
    assert loaded.plan.machines == (
        MachineRequest(Hardware(cpus=16), "us-west-1"),
        MachineRequest(Hardware(gpu="T4", gpus=1), "us-east-1", is_spot=True),
    )
    assert loaded.plan.carried == (ExportedInterface("service", "/detect", "std_srvs/srv/SetBool"),)
    assert loaded.robot_nodes == (RobotNode(CloudNode("robot", "robot_client"), "log"),)


def test_without_a_probe_nothing_is_started_and_this_is_said(tmp_path: Path) -> None:
    assert not load(written(tmp_path, LISTING), {}).is_known


def test_arguments_parameters_and_remappings_become_words_of_the_command_line(tmp_path: Path) -> None:
    file = written(tmp_path, "/**: {ros__parameters: {depth: 3}}", "p.yaml")
    path = written(tmp_path, WITH_ARGUMENTS.replace("PARAMETERS", str(file)))
    loaded = load(path, key_values(["where:=b", "rate:=50.5"]))
    assert loaded.plan.nodes[0].arguments == (
        *("-v", "--ros-args", "-r", "__node:=n", "-r", "__ns:=/b"),
        *("-p", "rate:=50.5", "-p", "deep.rates:=[1, 2]", "-p", "depth:=3", "-r", "in:=/out"),
    )
    assert loaded.keep
    assert loaded.is_known
    assert "other regions" in loaded.notes[0]


def test_a_plan_is_read_as_well(tmp_path: Path) -> None:
    plan = load(written(tmp_path, LISTING), {}).plan
    assert load(written(tmp_path, plan.to_json(), "plan.json"), {}).plan == plan


@pytest.mark.parametrize(
    ("given", "says"),
    [({}, "'where' is not given"), ({"where": "c"}, "expected a, b"), ({"wher": "a"}, "wher: not declared")],
)
def test_a_wrong_argument_is_named(tmp_path: Path, given: dict[str, str], says: str) -> None:
    with pytest.raises(LocalError, match=says):
        load(written(tmp_path, WITH_ARGUMENTS), given)


def test_a_word_that_is_no_argument_is_refused() -> None:
    with pytest.raises(LocalError, match="'rate=5': expected launch arguments as name:=value"):
        key_values(["rate=5"])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("import fog\ndef f(:\n  pass", r"launch\.py:2: SyntaxError"),
        ("import fog\nfog.FogCluster(cloud_nodes=[], deployment=[])", r"launch\.py:2: .*did you mean deployments\?"),
        ("import fog\n1/0", r"launch\.py:2: ZeroDivisionError"),
        ("import fog\nfog.CloudMachine(hardware='T5')", r"launch\.py:2: hardware 'T5'"),
        ("import fog\nfog.Node(package='a', executable='b', condition=1)", r"launch\.py:2: TypeError: .*'condition'"),
        ("from launch_ros.actions import Node", "from fog import LaunchDescription, Node"),
        ("x = 1", "generate_launch_description: expected a function"),
    ],
)
def test_a_fault_in_the_file_is_reported_with_its_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load(written(tmp_path, text), {})


@pytest.mark.parametrize(
    ("entities", "says"),
    [
        ("", "0 FogClusters: expected one"),
        ("3", "has a int"),
        ("FogCluster(cloud_nodes=['n'], deployments=[CloudMachine()])", "expected Node, not str"),
        ("FogCluster(cloud_nodes=[], deployments=[CloudMachine()])", "cloud_nodes is empty"),
    ],
)
def test_a_description_that_cannot_be_launched_is_refused(tmp_path: Path, entities: str, says: str) -> None:
    text = f"from fog import *\ndef generate_launch_description():\n    return LaunchDescription([{entities}])\n"
    with pytest.raises(LocalError, match=says):
        load(written(tmp_path, text), {})


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such launch file"):
        load(tmp_path / "absent.launch.py", {})


def test_importing_the_package_loads_nothing_else() -> None:
    script = (
        "import fog, sys; sys.exit(sum(name.startswith(('fog.', 'gdp', 'yaml', 'pydantic')) for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0


def test_an_error_has_its_line_where_the_file_is_named_by_a_relative_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.launch.py").write_text("import fog\n1/0\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"x\.launch\.py:2: ZeroDivisionError"):
        load(Path("x.launch.py"), {})
