"""Journals of real processes: what a switch and a RIB sent is sent again by their cores in memory, byte for byte."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from faults.overlay import Overlay
from survive import Flowing
from survive_rows import ROWS

from gdp.journal.incident import Incident
from gdp.journal.replay import Replay
from lab.process import new_run

pytestmark = [pytest.mark.netns, pytest.mark.nightly]


def test_a_run_with_a_cut_link_is_replayed_without_a_difference(tmp_path: Path) -> None:
    with new_run() as run, Overlay(run, ROWS["cut"].plan(50.0), has_journals=True) as overlay:
        overlay.start_all()
        assert Flowing(overlay).await_steady(time.monotonic_ns())
        overlay.spaces.cut("s2", "s4")
        time.sleep(1.0)
        overlay.spaces.restore_link("s2", "s4")
        time.sleep(1.0)
        overlay.save_journals(tmp_path)
    files = sorted(tmp_path.iterdir())
    assert [each.stem for each in files] == ["rib-s3", "switch-s1", "switch-s2", "switch-s3", "switch-s4"]
    for file in files:
        replay = Replay(Incident.from_bytes(file.read_bytes()))
        replay.run()
        assert replay.difference == "", file.stem
        assert replay.sent["keepalive"] > 10
