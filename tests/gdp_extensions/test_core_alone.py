"""The core works without extensions; each extension is found by an entry point."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from gdp.extras import MissingExtraError, Seam
from tests.pages import ROOT

_ABSENT = 'import sys\nsys.modules["gdp_extensions"] = None\n'
_RING = """
from lab.simulation import Simulation
from lab.topology import ring5
assert Simulation(topology=ring5()).run_until_attached()
"""
_TARGETS = re.findall(r'^([\w-]+) = "(gdp_extensions\.[\w.:]+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)


def run_alone(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter that finds no extension."""
    command = [sys.executable, "-c", _ABSENT + code]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)


def test_all_modules_of_the_core_are_imported_without_extensions() -> None:
    done = run_alone("from import_all import main\nsys.exit(main(['gdp', 'proxy', 'fog']))")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_ring_in_memory_attaches_without_extensions() -> None:
    done = run_alone(_RING)
    assert done.returncode == 0, done.stderr


def test_gdp_shows_its_help_without_extensions() -> None:
    done = run_alone("sys.argv = ['gdp', '--help']\nfrom gdp.cli.gdp import main\nmain()")
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout


def test_a_missing_extension_names_what_installs_it() -> None:
    tracers: Seam[object] = Seam("gdp.tracer")
    with pytest.raises(MissingExtraError, match=r"traces needs the extension absent \(run: .*\[absent\]'\)"):
        tracers.get("absent", "traces")


@pytest.mark.parametrize(("name", "target"), _TARGETS)
def test_an_entry_point_refers_to_what_is_there(name: str, target: str) -> None:
    assert EntryPoint(name, target, "").load() is not None
