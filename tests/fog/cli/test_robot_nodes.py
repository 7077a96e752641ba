"""Nodes that ``fog`` runs on the robot: their output, exit codes and end."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fog.cli.robot_nodes import Started, run
from fog.cluster import CloudNode, RobotNode
from gdp.errors import LocalError
from lab.process import until
from tests.pages import ROOT

FOREGROUND = """
import pathlib, sys
from tests.fog.cli.test_robot_nodes import node
from fog.cli.robot_nodes import run
word = "import time; open('up', 'w').close(); time.sleep(60)"
sys.exit(run([node(word)], pathlib.Path("nodes")))
"""


def node(text: str, output: str = "screen") -> Started:
    return RobotNode(CloudNode("p", "lib/talker"), output), (sys.executable, "-c", text)


def test_the_worst_exit_code_is_that_of_all(tmp_path: Path) -> None:
    assert run([node(""), node("raise SystemExit(3)")], tmp_path) == 3


def test_output_that_a_node_must_not_print_goes_to_a_named_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([node("print('word')", "log")], tmp_path / "nodes") == 0
    path = tmp_path / "nodes" / "0-talker.log"
    assert path.read_text() == "word\n"
    assert f"prints to {path}" in capsys.readouterr().err


def test_a_node_that_cannot_be_started_ends_those_that_were(tmp_path: Path) -> None:
    begun_s = time.monotonic()
    with pytest.raises(LocalError, match="nowhere"):
        run([node("import time; time.sleep(60)"), (RobotNode(CloudNode("p", "e")), ("/nowhere",))], tmp_path)
    assert time.monotonic() - begun_s < 30


def test_interrupted_it_ends_its_nodes(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", FOREGROUND], cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    )
    until((tmp_path / "up").exists)
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 130
