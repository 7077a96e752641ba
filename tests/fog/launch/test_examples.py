"""Examples of launch files: a rented machine finds their nodes in the wheels that it installs."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from fog.launch.load import load
from tests.pages import ROOT

DEMO = ROOT / "scripts" / "fog_demo"
FIND = """
import sys
from fog.cluster import CloudNode
from fog.launch.resolve import file_of
print(file_of(CloudNode(sys.argv[1], sys.argv[2]), {}))
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the unpacked wheel of the demonstration; it is built offline from a copy."""
    made = tmp_path_factory.mktemp("machine")
    shutil.copytree(DEMO, made / "source", ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(made), str(made / "source")]
    subprocess.run([*pip, *build], check=True, capture_output=True)
    (wheel,) = made.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(made / "installed")
    return made / "installed"


@pytest.mark.parametrize("name", ["echo", "counter"])
def test_a_rented_machine_finds_an_examples_nodes_in_the_demonstrations_wheel(name: str, machine: Path) -> None:
    nodes = load(ROOT / "examples" / f"{name}.launch.py", {}).plan.nodes
    assert nodes
    for node in nodes:
        found = subprocess.run(
            [sys.executable, "-c", FIND, node.package, node.executable],
            env={"PYTHONPATH": f"{machine}:{ROOT}"},
            cwd=machine,
            capture_output=True,
            text=True,
            check=True,
        )
        assert found.stdout.strip() == str(machine / node.package / f"{node.executable}.py")
