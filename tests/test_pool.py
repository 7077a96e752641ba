"""Budgets of folders: what takes half more than the other folders of its run is over its budget."""

from __future__ import annotations

import pytest

from tests.pool import _is_over, _lesser, _pace, folder_of

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
