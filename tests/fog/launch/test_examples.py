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

PACKAGES = (ROOT / "scripts" / "fog_demo", ROOT / "examples" / "grasp")
FIND = """
import sys
from fog.cluster import CloudNode
from fog.launch.resolve import file_of
print(file_of(CloudNode(sys.argv[1], sys.argv[2]), {}))
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the unpacked wheels of the examples' packages; they are built offline from copies."""
    made = tmp_path_factory.mktemp("machine")
    sources = [made / "source" / package.name for package in PACKAGES]
    for package, source in zip(PACKAGES, sources, strict=True):
        shutil.copytree(package, source, ignore=shutil.ignore_patterns("__pycache__"))
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-index", "--no-deps", "--no-build-isolation", "--wheel-dir", str(made), *map(str, sources)]
    subprocess.run([*pip, *build], check=True, capture_output=True)
    for wheel in made.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(made / "installed")
    return made / "installed"


@pytest.mark.parametrize("name", ["echo", "counter", "listing1"])
def test_a_rented_machine_finds_an_examples_nodes_in_the_wheel_of_their_package(name: str, machine: Path) -> None:
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
