"""Environment of the operator that foreign programs inherit."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import pytest

from fog.child_environment import child_environment
from fog.cli.robot_nodes import run
from fog.cluster import CloudNode, RobotNode
from fog.host.bounded_log import BoundedLog
from fog.host.managed_process import ManagedProcess
from fog.launch.interface_discovery_worker import _started
from fog.machine import Program

SECRETS = {"AWS_SECRET_ACCESS_KEY": "s", "AWS_PROFILE": "s", "SSH_AUTH_SOCK": "s", "GITHUB_TOKEN": "s"}
NEEDED = {"ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw", "CYCLONEDDS_URI": "c", "AMENT_PREFIX_PATH": "/opt/ros"}
PRINTS = "import json, os; json.dump(dict(os.environ), open('seen', 'w'))"


@pytest.fixture(autouse=True)
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for key, value in {**SECRETS, **NEEDED}.items():
        monkeypatch.setenv(key, value)


def assert_seen_without_secrets(own: str) -> None:
    seen = json.loads(Path("seen").read_text())
    assert not SECRETS.keys() & seen.keys()
    assert {key: seen.get(key) for key in NEEDED} == NEEDED
    assert {"PATH", own} <= seen.keys()


def test_a63_a_program_of_a_machine_inherits_no_credentials(tmp_path: Path) -> None:
    async def live() -> None:
        program = Program("node", ("{python}", "-c", PRINTS), environment={"OWN": "1"})
        log = BoundedLog(tmp_path / "log")
        incarnation_id = ManagedProcess(program, tmp_path, log, lambda: None)
        await asyncio.wait_for(incarnation_id.ended, 20)
        log.close()

    asyncio.run(live())
    assert_seen_without_secrets("OWN")


def test_a63_a_node_of_the_robot_inherits_no_credentials(tmp_path: Path) -> None:
    node = RobotNode(CloudNode("p", "talker", environment={"OWN": "1"}))
    assert run([(node, (sys.executable, "-c", PRINTS))], tmp_path) == 0
    assert_seen_without_secrets("OWN")


def test_a63_a_node_that_is_probed_inherits_no_credentials(tmp_path: Path) -> None:
    with _started({"argv": [sys.executable, "-c", PRINTS + "; input()"], "environment": {"OWN": "1"}}, tmp_path / "l"):
        while not (Path("seen").exists() and Path("seen").read_text().endswith("}")):
            pass
    assert_seen_without_secrets("OWN")


def test_a63_further_variables_are_passed_where_the_operator_says_so() -> None:
    given = {"FOG_PASS_ENVIRONMENT": "LICENSE, MODEL_*", "LICENSE": "1", "MODEL_A": "2", "MODEL": "3", "DISPLAY": ":0"}
    assert child_environment(given).keys() == {"FOG_PASS_ENVIRONMENT", "LICENSE", "MODEL_A"}
    assert "DISPLAY" in child_environment(given, has_desktop=True)


def test_a63_an_asterisk_alone_passes_nothing_more() -> None:
    assert "AWS_PROFILE" not in child_environment({"FOG_PASS_ENVIRONMENT": "*", "AWS_PROFILE": "s"})
