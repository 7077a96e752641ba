"""Base installation: a switch runs without the packages of the extras; a missing extra is named."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from gdp.extras import MissingExtraError, install_command, require_extra
from tests.pages import ROOT

_BLOCKER = """
import sys

class Blocker:
    blocked = {"apsw", "backports", "lz4", "numpy", "pybase64", "rosbags", "scapy"}

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

sys.meta_path.insert(0, Blocker())
"""

_NETWORK = """
from lab.topology import ring5
from lab.simulation import Simulation
assert Simulation(topology=ring5()).run_until_attached()
"""


def run_without_extras(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter that finds no package of the extras."""
    command = [sys.executable, "-c", _BLOCKER + code]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("module", ["gdp.cli.switch", "gdp.cli.rib", "gdp.cli.gdp"])
def test_a_command_of_gdp_shows_its_help_without_the_extras(module: str) -> None:
    done = run_without_extras(f"sys.argv = ['x', '--help']\nimport {module}\n{module}.main()")
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout


def test_switches_in_memory_forward_without_the_extras() -> None:
    done = run_without_extras(_NETWORK)
    assert done.returncode == 0, done.stderr


def test_a_clone_names_what_installs_an_extra_without_an_index_that_has_this_project(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gdp.extras.find_spec", lambda module: None)
    with pytest.raises(MissingExtraError) as caught:
        require_extra("dashboard", ["websockets"], "gdp dashboard")
    command = f"{sys.executable} -m pip install -e '{ROOT}[dashboard]'"
    assert str(caught.value) == f"gdp dashboard needs websockets (run: {command})"


def test_the_scapy_data_plane_names_its_extra_when_scapy_is_missing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("gdp.extras.find_spec", lambda module: None)
    monkeypatch.setattr("gdp.extras._ROOT", tmp_path)
    with pytest.raises(MissingExtraError, match=r"needs scapy \(run: pip install 'gdp-ros\[scapy\]'\)"):
        require_extra("scapy", ("scapy",), "data plane scapy")


@pytest.mark.parametrize(("package", "module"), [("proxy", "proxy"), ("fog", "fog.cli")])
def test_a_package_names_its_extra_when_it_is_missing(package: str, module: str) -> None:
    code = "import importlib.util\nimportlib.util.find_spec = lambda name: None\n"
    done = run_without_extras(code + f"import {module}")
    assert install_command(package) in done.stderr
