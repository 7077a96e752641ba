"""Reruns: a failure that passes on a rerun fails the run, unless the quarantine list holds the test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rerun_check

TEST, CASE = "tests/a/test_b.py::test_c", "tests.a.test_b::test_c"


def quarantine(folder: Path, text: str) -> Path:
    path = folder / "quarantine.yaml"
    path.write_text(text)
    return path


def entry(number: int) -> str:
    return f"- {{test: 'tests/test_a.py::test_{number}', reason: slow}}\n"


def test_a_failure_that_passes_on_the_rerun_fails_the_run() -> None:
    (line,) = rerun_check.counted_failures({CASE: False}, {CASE: True}, [])
    assert line.startswith(f"{CASE}: failed, then passed on the rerun")


def test_a_quarantined_test_may_pass_on_the_rerun() -> None:
    assert rerun_check.counted_failures({CASE: False}, {CASE: True}, [TEST]) == []


def test_a_quarantined_test_covers_its_parameters() -> None:
    assert rerun_check.counted_failures({f"{CASE}[x]": False}, {f"{CASE}[x]": True}, [TEST]) == []


def test_a_quarantined_test_that_fails_twice_fails_the_run() -> None:
    assert rerun_check.counted_failures({CASE: False}, {CASE: False}, [TEST]) == [f"{CASE}: failed twice"]


def test_a_failure_that_the_rerun_left_out_fails_the_run() -> None:
    assert len(rerun_check.counted_failures({CASE: False}, {}, [TEST])) == 1


def test_tests_that_passed_at_once_are_not_looked_at_again() -> None:
    assert rerun_check.counted_failures({CASE: True}, {}, []) == []


def test_the_quarantine_list_of_the_project_is_valid() -> None:
    assert len(rerun_check.read_quarantine(rerun_check.QUARANTINE)) <= rerun_check.ENTRIES_MAX


def test_five_tests_may_be_quarantined_and_six_may_not(tmp_path: Path) -> None:
    assert len(rerun_check.read_quarantine(quarantine(tmp_path, "".join(map(entry, range(5)))))) == 5
    with pytest.raises(rerun_check.QuarantineError, match="6 entries, at most 5"):
        rerun_check.read_quarantine(quarantine(tmp_path, "".join(map(entry, range(6)))))


@pytest.mark.parametrize(
    "text", ["{}", "- tests/test_a.py", "- {test: 'a.py::b'}", "- {test: 'a.py::b', reason: ' '}", entry(1) * 2, "["]
)
def test_a_quarantine_list_without_reasons_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(rerun_check.QuarantineError, match=r"quarantine\.yaml"):
        rerun_check.read_quarantine(quarantine(tmp_path, text))


def test_outcomes_are_read_from_the_report_of_pytest(tmp_path: Path) -> None:
    (tmp_path / "test_x.py").write_text(
        "import pytest\ndef test_good(): pass\ndef test_bad(): assert 0\n@pytest.mark.skip\ndef test_left_out(): pass\n"
    )
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--junit-xml", "report.xml", "test_x.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout
    assert rerun_check.read_outcomes(tmp_path / "report.xml") == {
        "test_x::test_good": True,
        "test_x::test_bad": False,
        "test_x::test_left_out": True,
    }


def test_a_missing_report_is_wrong_input(tmp_path: Path) -> None:
    with pytest.raises(rerun_check.QuarantineError, match=r"none\.xml"):
        rerun_check.read_outcomes(tmp_path / "none.xml")
