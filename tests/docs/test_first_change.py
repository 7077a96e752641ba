"""Page on the first change: its test fails before its change, and passes after it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT, blocks

_BLOCKS = blocks(ROOT / "docs/contributing/first-change.md")
(_TEST,) = (block for block in _BLOCKS if block.language == "python")
(_CHANGE,) = (block for block in _BLOCKS if block.language == "diff")


def _run_test(clone: Path) -> str:
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", _TEST.title]
    environment = {**os.environ, "PYTHONPATH": str(clone), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return subprocess.run(words, cwd=clone, env=environment, capture_output=True, text=True, check=False).stdout


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_the_test_of_the_page_fails_until_its_change_is_made(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "gdp", tmp_path / "gdp", ignore=shutil.ignore_patterns("__pycache__"))
    path = tmp_path / _TEST.title
    path.parent.mkdir(parents=True)
    path.write_text(_TEST.text)
    assert "KeyError: 'payload'" in _run_test(tmp_path)
    subprocess.run(["git", "apply", "-"], cwd=tmp_path, input=_CHANGE.text, text=True, check=True)
    assert "1 passed" in _run_test(tmp_path)
