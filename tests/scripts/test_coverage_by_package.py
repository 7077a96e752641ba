"""Branch coverage of each package."""

from __future__ import annotations

import pytest

from coverage_by_package import percentages

SUMMARIES = {
    "gdp/frame/codec.py": (80, 20, 90, 30),
    "gdp/frame/kinds.py": (20, 0, 20, 0),
    "gdp/names.py": (10, 0, 40, 0),
    "fog/plan/choice.py": (10, 10, 10, 10),
}
KEYS = ("covered_lines", "covered_branches", "num_statements", "num_branches")


@pytest.mark.parametrize(
    ("package", "percent"),
    [("gdp.frame", 120 / 1.4), ("gdp", 130 / 1.8), ("fog.plan", 100.0), ("total", 150 / 2.0)],
)
def test_coverage_of_a_package_counts_its_statements_and_branches(package: str, percent: float) -> None:
    files = {path: {"summary": dict(zip(KEYS, counts, strict=True))} for path, counts in SUMMARIES.items()}
    assert percentages(files)[package] == pytest.approx(percent)
