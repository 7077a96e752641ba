"""Power cuts of real file systems while a holder and a robot write: what was confirmed is there, and can be read."""

from __future__ import annotations

import json

import pytest

from lab.process import LabProcess, calling, new_run
from netns_tests import power_cuts
from tests.draws import TIMES
from tests.lanes import nightly

pytestmark = pytest.mark.netns

_PATIENCE_S = 300.0


def faults(cuts: int, broken: str = "") -> list[str]:
    """Return what was wrong after so many cuts of each file system; skips where none can be mounted."""
    space = ["unshare", "--mount", "--pid", "--mount-proc", "--fork", "--kill-child"]  # all ends with it
    with new_run() as run:
        words = calling(power_cuts.main, run.directory / "disk", cuts, TIMES, broken)
        with LabProcess(run, "power", [*space, *words]) as process:
            said = [json.loads(line) for line in process.output(_PATIENCE_S).splitlines()]
    if "refused" in said[0]:
        pytest.skip(f"no file system can be mounted: {said[0]['refused']}")
    assert broken or sum(each.get("cuts", 0) for each in said) == cuts * len(power_cuts.FORMATS)
    return [each["wrong"] for each in said if "wrong" in each]


@pytest.mark.parametrize("cuts", [3, *nightly(50)])
def test_a_power_cut_loses_nothing_that_was_confirmed(cuts: int) -> None:
    assert faults(cuts) == []


@pytest.mark.parametrize("call", ["fdatasync", "fsync"])
def test_a_holder_that_does_not_flush_is_found(call: str) -> None:
    assert faults(40, broken=call)
