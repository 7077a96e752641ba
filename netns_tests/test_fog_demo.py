"""Demonstration of preempted machines: no request fails, and no resource stays behind."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from fog_demo.cluster import STATE, standing_runs, sweep
from gdp.host.run_registry import RunRegistry
from netns_tests.local_site import leftovers
from tests.pages import ROOT

pytestmark = [
    pytest.mark.netns,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed: setup.sh --ros2"),
]

_PATIENCE_S = 200.0


def command(*options: object) -> list[str]:
    """Return the command line of a demonstration."""
    launch_file = ROOT / "examples" / "echo.launch.py"
    return [sys.executable, "-m", "fog_demo", str(launch_file), *map(str, options)]


def all_of(record_of: int) -> tuple[Path, list[str]]:
    """Return the folder of the provider's records, and the ids of everything that a running demonstration made."""
    (demo,) = (each for each in standing_runs("demo").all() if each.owner.pid == record_of)
    records = Path(demo.files[0]) / STATE / "local"
    return records, [demo.run, *(each.run for each in RunRegistry(records).all())]


def line_with(words: Sequence[str], process: subprocess.Popen[str]) -> str:
    """Return the next line that contains all these words."""
    assert process.stdout is not None
    for line in process.stdout:
        if all(word in line for word in words):
            return line
    raise AssertionError(f"no line with {words}")


@pytest.mark.nightly
def test_no_request_fails_while_one_machine_is_preempted_and_the_other_one_killed() -> None:
    options = ("--calm", 0.5, "--notice", 4, "--json")
    ended = subprocess.run(command(*options), capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert ended.returncode == 0, ended.stderr
    reported = json.loads(ended.stdout)
    assert reported["failed"] == 0
    assert reported["requests"] > 100
    happened = {(each["machine"], each["what"]) for each in reported["events"]}
    assert {("m1", "notice"), ("m2", "preempted"), ("m3", "serving"), ("m4", "serving")} <= happened
    assert {"m1", "m2"} & reported["by_machine"].keys()


def test_what_a_killed_demonstration_left_is_taken_down_by_the_next_one() -> None:
    with subprocess.Popen(command(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        line_with(["m2", "requested"], process)
        records, ids = all_of(process.pid)
        process.kill()
    assert leftovers(records, ids), "there was something to take down"
    assert ids[0] in sweep(standing_runs("demo"))
    assert leftovers(records, ids) == []


def test_help_shows_an_example() -> None:
    reported = subprocess.run(command("--help"), capture_output=True, text=True, timeout=_PATIENCE_S, check=True).stdout
    assert "sudo scripts/fog_demo.sh" in reported
    assert "FILE" not in reported.splitlines()[1]
