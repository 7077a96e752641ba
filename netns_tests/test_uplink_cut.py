"""Two uplinks over real tunnels: a cut of either delays no message of a topic with two paths, and loses none at all."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT

pytestmark = [
    pytest.mark.netns,
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
]

PATIENCE_S = 300.0
BEFORE_DETECTION_MS = 180  # three missed keepalives take 210 ms; a busy machine delays some messages by less


@pytest.mark.nightly
def test_a_cut_of_either_uplink_delays_no_message_over_two_paths_and_loses_none(tmp_path: Path) -> None:
    record = tmp_path / "record.json"
    bench = ROOT / "scripts" / "bench" / "uplink_cut.py"
    options = {"rounds": 2, "limit-ms": BEFORE_DETECTION_MS, "json": record}
    argv = [sys.executable, str(bench), "--allow-load", *(f"--{name}={value}" for name, value in options.items())]
    ran = subprocess.run(argv, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ran.returncode == 0, ran.stderr
    cases = json.loads(record.read_text())["rounds"]["tunnels"]
    assert cases["paths: 2"]["late"] == [0, 0], ran.stdout
    for case in cases.values():
        assert case["lost"] == case["doubled"] == [0], ran.stdout
