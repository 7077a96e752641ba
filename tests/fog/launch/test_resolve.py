"""Resolution of a node's executable to a command line."""

import subprocess
import sys
from pathlib import Path

import pytest

from fog.cluster import CloudNode
from fog.launch.resolve import command_line, deferred
from gdp.errors import LocalError


def test_an_installed_executable_comes_before_a_module(tmp_path: Path) -> None:
    path = tmp_path / "lib" / "fog_demo" / "echo"
    path.parent.mkdir(parents=True)
    path.touch(mode=0o755)
    environment = {"AMENT_PREFIX_PATH": f"/nowhere:{tmp_path}"}
    assert command_line(CloudNode("fog_demo", "echo", ("-x",)), environment) == (str(path), "-x")


def test_a_python_module_is_run_by_the_machines_python() -> None:
    assert command_line(CloudNode("fog_demo", "echo"), {}) == ("{python}", "-m", "fog_demo.echo")


@pytest.mark.parametrize("package", ["fog_demo", "no_such_package"])
def test_what_is_nowhere_is_refused(package: str) -> None:
    with pytest.raises(LocalError, match=f"{package}/talker: not found"):
        command_line(CloudNode(package, "talker"), {"AMENT_PREFIX_PATH": ""})


def test_a_machine_with_other_packages_looks_itself() -> None:
    assert deferred(CloudNode("a", "b", ("c",))) == ("{python}", "-m", "fog.launch.run", "a", "b", "c")


def test_a_machine_becomes_the_node_or_says_that_it_has_none() -> None:
    run = [sys.executable, "-m", "fog.launch.run"]
    found = subprocess.run([*run, "json", "tool", "--help"], capture_output=True, text=True, check=True)
    assert "json.tool" in found.stdout
    missing = subprocess.run([*run, "json", "absent"], capture_output=True, text=True, check=False)
    assert (missing.returncode, missing.stderr.splitlines()[0][:26]) == (2, "error: json/absent: not fo")
