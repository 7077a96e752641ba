"""Sans-I/O parts that all benches share: figures over rounds."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts" / "bench"))

from machine import machine_state
from report import Rounds, Spread, number_text, percentile, write_json

CASE, COLUMN = "1,400 B", "frames/s"


def rounds(**values: list[float | None]) -> Rounds:
    over = Rounds()
    for contender, each in values.items():
        for value in each:
            over.add(contender, CASE, COLUMN, value)
    return over


def test_a_ratio_is_taken_in_each_round_before_the_median() -> None:
    target = rounds(ours=[20.0, 2.0, 30.0], theirs=[10.0, 1.0, 30.0]).ratio("", "ours", "theirs", CASE, COLUMN, 1.5)
    assert target.measured == Spread(2.0, 1.0, 2.0)
    assert target.met


def test_a_round_that_failed_on_one_side_is_no_ratio() -> None:
    target = rounds(ours=[None, 3.0], theirs=[1.0, 1.0]).ratio("", "ours", "theirs", CASE, COLUMN, 4.0)
    assert target.measured == Spread(3.0, 3.0, 3.0)
    assert not target.met
    assert "MISSED" in str(target)


def test_an_upper_bound_is_kept_from_below() -> None:
    over = rounds(ours=[7.0], theirs=[10.0])
    assert over.ratio("", "ours", "theirs", CASE, COLUMN, 0.7, at_most=True).met
    assert not over.ratio("", "ours", "theirs", CASE, COLUMN, 0.6, at_most=True).met
    assert not over.difference("", "theirs", "ours", CASE, COLUMN, 2.5).met


def test_who_was_not_measured_leaves_a_reason_in_place_of_a_figure() -> None:
    target = rounds(theirs=[1.0]).ratio("speed", "ours", "theirs", CASE, COLUMN, 1.0)
    assert target.met is None
    assert str(target) == "speed: target ≥ 1.00, not measured: ours was not asked for"


def test_a_figure_without_a_bound_is_only_printed() -> None:
    target = rounds(ours=[1.0], theirs=[4.0]).ratio("peer", "ours", "theirs", CASE, COLUMN, None)
    assert target.met is None
    assert str(target) == "peer: measured 0.25"


@pytest.mark.parametrize(("share", "value"), [(0.5, 50), (0.99, 99), (1.0, 100), (0.0, 1)])
def test_a_percentile_is_one_of_the_values(share: float, value: int) -> None:
    assert percentile(range(100, 0, -1), share) == value


def test_no_values_have_no_percentile() -> None:
    with pytest.raises(ValueError, match="no values"):
        percentile([], 0.5)


@pytest.mark.parametrize(
    ("value", "text"),
    [(450_123.4, "450,123"), (244.4, "244"), (15.64, "15.6"), (0.7, "0.70"), (0.0123, "0.012"), (0, "0.00")],
)
def test_a_figure_shows_the_digits_that_mean_something(value: float, text: str) -> None:
    assert number_text(value) == text


def test_the_file_holds_every_round_and_what_came_of_the_goals(tmp_path: Path) -> None:
    over = rounds(ours=[1.0, 2.0], theirs=[1.0, 1.0])
    target = over.ratio("speed", "ours", "theirs", CASE, COLUMN, 1.5)
    path = tmp_path / "new" / "figures.json"
    write_json(path, "forwarding", machine_state(), {"MTU": [1_500]}, over, [target])
    written = json.loads(path.read_text())
    assert written["rounds"]["ours"][CASE][COLUMN] == [1.0, 2.0]
    assert written["targets"][0]["met"]
    assert written["machine"]["kernel"]
