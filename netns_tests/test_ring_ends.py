"""Ends of the ring demonstration: Ctrl-C, a kill in the middle, and a ring that is kept until it is taken down."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gdp.errors import LocalError
from gdp.host.cgroups import Cgroup
from gdp.host.run_registry import RunRegistry
from netns_tests.test_ring import PROJECT, command, left_of, make_demo, ring

pytestmark = pytest.mark.netns

GROUPS = Path("/sys/fs/cgroup")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_demo(tmp_path_factory.mktemp("demo"), 1)


def started(demo: Path, *more: str) -> tuple[subprocess.Popen[str], str]:
    """Start a run and wait until traffic flows; return it and its id."""
    process = subprocess.Popen(command(demo, "--seconds", 5, *more), stderr=subprocess.PIPE, text=True, cwd=PROJECT)
    run = ""
    assert process.stderr is not None
    for line in process.stderr:
        if " run " in line and ": five" in line:
            run = line.split(" run ")[1].split(":")[0]
        if "replaying" in line:
            return process, run
    raise AssertionError("the ring ended before it replayed")


@dataclass(frozen=True, slots=True)
class Aftermath:
    """A run that was killed while traffic flowed, and the next one, which is kept.

    ``members`` and ``weights``: of the killed run's control groups. ``left``: remains before the next run and after it.
    """

    members: list[list[str]]
    weights: dict[str, int]
    left: tuple[list[str], list[str]]
    kept: str
    settings: dict[str, Any]


@pytest.fixture(scope="module")
def aftermath(demo: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Aftermath]:
    process, killed = started(demo, "--cores")
    with process:
        members = [path.read_text().split() for path in GROUPS.glob(f"**/gdp-{killed}-*/cgroup.procs")]
        process.kill()
    weights = {
        path.parent.name.removeprefix(f"gdp-{killed}-"): int(path.read_text())
        for pattern in ("cpu.weight", "cpu.shares")
        for path in GROUPS.glob(f"**/gdp-{killed}-*/{pattern}")
    }
    before, file = left_of(killed), tmp_path_factory.mktemp("kept") / "result.json"
    ended = ring(demo, "--rate", 0, "--cores", "--keep", "--json", file)
    assert ended.returncode == 0, ended.stderr
    kept = ended.stderr.split("The ring of run ")[1].split(" ")[0]
    left = before, [*left_of(killed), *map(str, GROUPS.glob(f"**/gdp-{killed}-*"))]
    yield Aftermath(members, weights, left, kept, json.loads(file.read_text())["settings"])
    if left_of(kept):
        ring("--down")


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.nightly)]
)
def test_an_interrupted_run_leaves_nothing(demo: Path, number: signal.Signals, code: int) -> None:
    process, run = started(demo)
    with process:
        process.send_signal(number)
        assert process.wait(30) == code
    assert left_of(run) == []


def test_what_a_killed_run_left_is_gone_with_the_next(aftermath: Aftermath) -> None:
    before, after = aftermath.left
    assert before != []
    assert after == []


def test_machines_have_their_cores_by_control_groups(aftermath: Aftermath) -> None:
    probe = Cgroup(f"gdp-test-{os.getpid()}")
    try:
        probe.make()
        probe.share_cpu(1)
    except LocalError as error:
        pytest.skip(f"no control groups with weights here: {error}")
    finally:
        probe.remove()
    assert aftermath.members
    assert all(aftermath.members)
    weights = {machine: weight / aftermath.weights["nuc1"] for machine, weight in aftermath.weights.items()}
    assert weights == {"nuc1": 1.0, **dict.fromkeys(("nuc2", "nuc3", "nuc4", "nuc5"), 2.0)}
    assert aftermath.settings["cores"] == {"nuc1": 2, "nuc2": 4, "nuc3": 4, "nuc4": 4, "nuc5": 4}


def test_a_kept_ring_stands_until_it_is_taken_down(aftermath: Aftermath) -> None:
    assert aftermath.kept not in RunRegistry().sweep()
    assert left_of(aftermath.kept) != []
    down = ring("--down")
    assert aftermath.kept in down.stderr
    assert left_of(aftermath.kept) == []
