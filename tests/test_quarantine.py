"""Quarantine: a marked test may fail once, and no other may; at most five are marked, each with a reason."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT
from tests.quarantine import TESTS_MAX

HEAD = "import pathlib, pytest\n\n@pytest.fixture\ndef runs():\n    file = pathlib.Path('runs')\n"
HEAD += "    file.write_text((file.read_text() if file.exists() else '') + '.')\n    return len(file.read_text())\n\n"


def outcome(folder: Path, text: str) -> tuple[int, str]:
    """Return the exit status and the output of pytest on tests in a folder of their own."""
    (folder / "test_x.py").write_text(HEAD + text)
    words = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "tests.quarantine",
        "--strict-markers",
    ]
    options = ["-o", "markers=quarantined(reason): may fail once", "--rootdir", str(folder), "test_x.py"]
    done = subprocess.run(
        [*words, *options], cwd=folder, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def marked(name: str, check: str, reason: str = "slow") -> str:
    return f"@pytest.mark.quarantined('{reason}')\ndef test_{name}(runs):\n    assert {check}\n\n"


@pytest.mark.parametrize(("check", "status"), [("runs == 1", 0), ("runs == 2", 0), ("runs == 3", 1)])
def test_a_marked_test_may_fail_once_and_has_new_fixtures_then(tmp_path: Path, check: str, status: int) -> None:
    assert outcome(tmp_path, marked("a", check))[0] == status
    assert (tmp_path / "runs").read_text() == ("." if check == "runs == 1" else "..")


def test_a_failure_of_another_test_counts_at_once(tmp_path: Path) -> None:
    status, said = outcome(tmp_path, "def test_a(runs):\n    assert runs == 2\n")
    assert (status, "1 failed" in said, (tmp_path / "runs").read_text()) == (1, True, ".")


def test_five_tests_may_be_marked_and_six_may_not(tmp_path: Path) -> None:
    five = "".join(marked(str(number), "runs") for number in range(TESTS_MAX))
    assert outcome(tmp_path, five)[0] == 0
    status, said = outcome(tmp_path, five + marked("more", "runs"))
    assert (status, "6 tests are quarantined, at most 5" in said) == (4, True)


def test_a_mark_needs_a_reason(tmp_path: Path) -> None:
    status, said = outcome(tmp_path, marked("a", "runs", " "))
    assert (status, "quarantined needs a reason" in said) == (4, True)
