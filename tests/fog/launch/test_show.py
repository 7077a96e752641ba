"""Dry run of a launch: its table, prices and latencies."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fog.cli import launch_view
from fog.cli.launch_view import Priced, loaded_from, priced, show_plan
from fog.hardware import Hardware, Offer
from fog.latency.known import Latency
from fog.launch.load import Loaded
from tests.fog.launch.test_load import LISTING, written
from tests.pages import ROOT

OFFER = Offer("aws", "us-west-1", "c5.4xlarge", Hardware(16, 32.0), is_spot=False, usd_per_hour=0.8)


LATENCIES = {"us-west-1": Latency(12.5, "measured now, tcp://127.0.0.1:7")}


def of(loaded: Loaded, *choice: Offer | None) -> Priced:
    return Priced(loaded, choice, LATENCIES)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_a_dry_run_starts_nothing_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch_view, "offered", pytest.fail)
    loaded = loaded_from(written(tmp_path, LISTING), [], dry_run=True)
    assert priced(of(loaded, OFFER, OFFER))["carried"] is None


def test_a_dry_run_shows_what_was_found_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = (("service", "/detect", "std_srvs/srv/SetBool"),)
    monkeypatch.setattr(launch_view, "kept", lambda _: found)
    monkeypatch.setattr(launch_view, "offered", lambda _: found)
    loaded = loaded_from(written(tmp_path, LISTING), [], dry_run=True)
    assert priced(of(loaded, OFFER, OFFER))["carried"] == [
        {"kind": "service", "name": "/detect", "type": "std_srvs/srv/SetBool"}
    ]


def test_the_price_is_the_machines_and_unknown_if_one_is_not_to_be_had(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = loaded_from(written(tmp_path, LISTING), [], dry_run=True)
    show_plan(of(loaded, OFFER, replace(OFFER, usd_per_hour=0.2)), as_json=True)
    said = json.loads(capsys.readouterr().out)
    assert (said["usd_per_hour"], said["usd_per_month"]) == (1.0, 730.0)
    show_plan(of(loaded, OFFER, None), as_json=False)
    shown = capsys.readouterr().out
    assert "price   unknown" in shown
    assert "0.8000" in shown


def test_how_far_a_machine_is_and_where_that_comes_from_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = loaded_from(written(tmp_path, LISTING), [], dry_run=True)
    machines: Any = priced(of(loaded, OFFER, OFFER))["machines"]
    assert machines[0]["latency_ms"] == 12.5
    show_plan(of(loaded, OFFER, OFFER), as_json=False)
    assert "latency us-west-1 12.5 ms: measured now, tcp://127.0.0.1:7" in capsys.readouterr().out


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.launch.py")), ids=lambda path: path.name)
def test_the_examples_load(path: Path) -> None:
    loaded = loaded_from(path, [], dry_run=True)
    show_plan(of(loaded, *[OFFER] * len(loaded.plan.machines)), as_json=False)
