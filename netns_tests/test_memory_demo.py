"""Demonstration of a robot's memory: the window around the emergency stop is whole, and its holder read nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from proxy.recordings.reader import BagReader
from tests.pages import ROOT

pytestmark = [pytest.mark.netns, pytest.mark.nightly]

_PATIENCE_S = 300.0


def test_the_window_around_the_stop_is_whole(tmp_path: Path) -> None:
    output = tmp_path / "incident.mcap"
    words = [sys.executable, "-m", "memory_demo", "--json", "-o", str(output)]
    ended = subprocess.run(
        words, capture_output=True, text=True, timeout=_PATIENCE_S, check=False, cwd=ROOT / "scripts"
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    said = json.loads(ended.stdout)
    assert (said["messages missing in it"], said["readable bytes at the holder"], said["problems"]) == (0, 0, [])
    assert said["window, s"] >= 8
    assert said["messages in the window"] < said["messages of the drive"] / 2
    with BagReader(output) as reader:
        assert sum(1 for _ in reader.messages()) == said["messages in the window"]
