"""Demonstration of one tree of transforms: each transform of both robots is there once, and a picture is drawn."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT

pytest.importorskip("matplotlib")

pytestmark = [pytest.mark.netns, pytest.mark.nightly]

_PATIENCE_S = 300.0


def test_two_robots_are_drawn_in_one_tree(tmp_path: Path) -> None:
    output = tmp_path / "fleet.png"
    words = [sys.executable, "-m", "fleet_demo", "-o", str(output)]
    ended = subprocess.run(
        words, capture_output=True, text=True, timeout=_PATIENCE_S, check=False, cwd=ROOT / "scripts"
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    rows = dict(line.rsplit(maxsplit=1) for line in ended.stdout.splitlines() if line[-1:].isdigit())
    assert rows.items() >= {("wrong or doubled", "0"), ("lost", "0")}
    assert int(rows["transforms"]) > 1_000
    assert output.read_bytes().startswith(b"\x89PNG")
