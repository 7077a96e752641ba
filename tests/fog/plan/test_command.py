"""``fog plan`` command: its answers, assumptions and refusals."""

from __future__ import annotations

import json
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from fog.cli.plan import cost_table, plan

app = typer.Typer()
app.command("plan")(plan)
app.command("prices")(cost_table)


def run(*words: str) -> str:
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    return result.stdout


def planned(*words: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(run("plan", *words, "--json"))
    return document


def test_the_papers_example_is_answered_with_two_replicas() -> None:
    answer = planned("--target", "0.0005", "--uptime", "15h", "--recovery", "20min")
    assert answer["replicas"] == 2
    assert answer["p_system"] == pytest.approx(0.000473, abs=1e-6)
    assert len({each["region"] for each in answer["choice"]}) == 2


def test_a_plan_without_more_says_what_it_assumes_and_gives_both_numbers() -> None:
    answer = planned("--target", "0.0005")
    assert answer["independent"]["replicas"] == 2
    assert answer["one_region"]["replicas"] == 3
    said = " ".join(answer["assumptions"])
    for words in ("15h", "20min", "worked example", "independently", "1.63 to 3.69", "no data"):
        assert words in said


def test_machines_that_have_to_share_a_region_are_more() -> None:
    answer = planned("--target", "0.0005", "--region", "us-east-1")
    assert answer["replicas"] == 3
    assert answer["independent"]["replicas"] == 2


def test_a_target_out_of_reach_in_one_region_is_said_to_be() -> None:
    answer = planned("--target", "0.0005", "--region", "us-east-1", "--uptime", "40min")
    assert answer["one_region"]["replicas"] is None
    assert answer["p_system"] > 0.0005
    assert "out of reach" in " ".join(answer["assumptions"])


def test_machines_that_run_already_are_not_added_again() -> None:
    assert planned("--target", "0.0005", "--have", "spot:2")["add"] == {"spot": 0, "on-demand": 0}
    mixed = planned("--target", "0.0005", "--have", "spot", "--mixed")
    assert (mixed["replicas"], mixed["add"]) == (2, {"spot": 1, "on-demand": 0})


def test_on_demand_machines_are_counted_with_what_is_promised_for_one() -> None:
    answer = planned("--target", "0.0005", "--on-demand", "--provider", "local")
    assert (answer["p_vm"], answer["replicas"]) == (0.005, 2)
    assert not any(each["spot"] for each in answer["choice"])


def test_people_get_tables() -> None:
    shown = run("plan", "--target", "0.0005", "--hardware", "cpu:16")
    assert "replicas: 2" in shown
    assert "Assumed:" in shown
    assert "g4dn" in run("prices", "--hardware", "T4", "--region", "us-east-1")


def test_the_price_table_has_both_prices_and_how_often_machines_are_taken() -> None:
    document = json.loads(run("prices", "--hardware", "T4", "--region", "us-east-1", "--json"))
    (cheapest, *_) = document["offers"]
    assert cheapest["type"] == "g4dn.xlarge"
    assert cheapest["spot_usd_per_hour"] < cheapest["on_demand_usd_per_hour"] == 0.526
    assert cheapest["taken_a_month"].endswith("%")
    assert document["sources"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--target", "2"), "between 0 and 1"),
        (("--target", "0.1", "--uptime", "long"), "span of time"),
        (("--target", "0.1", "--recovery", "0s"), "more than no time"),
        (("--target", "0.1", "--region", "mars"), "us-east-1"),
        (("--target", "0.1", "--hardware", "cpu:1000"), "the nearest is"),
        (("--target", "0.1", "--have", "many"), "spot:2"),
        (("--target", "0.1", "--latency", "us-east-1"), "us-east-1=70"),
        (("--target", "0.1", "--provider", "azure"), "local, aws"),
    ],
)
def test_a_wrong_question_is_answered_in_one_line(words: tuple[str, ...], said: str) -> None:
    result = CliRunner().invoke(app, ["plan", *words])
    assert result.exit_code == 2
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
