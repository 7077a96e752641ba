"""Budgets of folders: what takes half more than the other folders of its run is over its budget. Order of files."""

from __future__ import annotations

import pytest

from tests.pool import _is_over, _lesser, _next_unit, _pace, folder_of

BUDGETS = {"tests/attacks": 100.0, "tests/journeys": 200.0, "netns_tests": 300.0, "tests/vectors": 1.0}


@pytest.mark.parametrize("speed", [0.5, 1.0, 3.0])
def test_a_slower_machine_is_no_excess_and_a_slower_folder_is(speed: float) -> None:
    spent = {folder: seconds * speed for folder, seconds in BUDGETS.items()}
    spent["tests/journeys"] *= 1.6
    pace = _pace(spent, BUDGETS)
    over = [folder for folder, seconds in spent.items() if _is_over(seconds / pace, BUDGETS[folder])]
    assert over == ["tests/journeys"]


def test_a_budget_only_falls_and_follows_the_files_that_there_are() -> None:
    old = {"a.py": [2.0, 1.0], "gone.py": [9.0, 9.0]}
    assert _lesser(old, {"a.py": [1.0, 3.0], "new.py": [4.0, 4.0]}) == {"a.py": [1.0, 1.0], "new.py": [4.0, 4.0]}


def test_a_file_that_skipped_tests_keeps_its_budget() -> None:
    assert _lesser({"a.py": [2.0, 1.0]}, {"a.py": [0.1, 0.1]}, {"a.py"}) == {"a.py": [2.0, 1.0]}


def test_a_folder_is_that_of_its_package() -> None:
    assert folder_of("tests/gdp/switch/test_table.py") == "tests/gdp/switch"
    assert folder_of("tests/attacks/test_joins.py") == "tests/attacks"
    assert folder_of("netns_tests/test_ring.py") == "netns_tests"


def test_a_worker_waits_while_others_compute_and_computes_while_they_wait() -> None:
    known = {
        "waits.py": [9.0, 1.0],
        "computes.py": [8.0, 8.0],
        "waits_less.py": [2.0, 0.1],
        "computes_less.py": [1.0, 1.0],
    }
    queue = ["waits.py::one", "computes.py", "waits_less.py", "computes_less.py"]  # the longest first
    assert _next_unit(queue, known, []) == "computes.py"
    assert _next_unit(queue, known, [0.1, 0.2]) == "computes.py"
    assert _next_unit(queue, known, [0.1, 1.0]) == "waits.py::one"
    assert _next_unit(queue[1::2], known, [1.0, 1.0]) == "computes.py"
