"""Files for Prometheus and Grafana: what they ask for is what nodes export, and promtool accepts and plays them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from gdp.errors import DropReason
from gdp.names import Name
from gdp.telemetry.health import Health
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import DeviceCounts, Histogram, NeighbourRow, PortRow, Sources, TopicCounts
from tests.pages import ROOT

FOLDER: Final = ROOT / "examples" / "monitoring"
BY_PROMETHEUS: Final = frozenset(("instance", "job", "role", "le"))
needs_promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="needs promtool (scripts/setup.sh --dev)")


def exported() -> dict[str, set[str]]:
    """Return the labels of every series that a node with all sources exports, by name."""
    one = lambda: {"x": 1}  # noqa: E731
    counts = ("frames", "rib_answers", "rib_refusals", "messages", "message_bytes", "repairs", "lost", "unconfirmed")
    more = ("faults", "calls", "waiting", "two_paths")
    seen = Histogram()
    seen.observe(0.1)
    sources: Any = {
        **dict.fromkeys((*counts, *more), one),
        **dict.fromkeys(("table_entries", "pending_frames", "clashes"), lambda: 1.0),
        "drops": lambda: dict.fromkeys(DropReason, 1),
        "entries": lambda: {bytes(64): (1, 2)},
        "links": lambda: [NeighbourRow(port="eth0", name=Name(bytes(32)), rtt_s=0.1, cost=10)],
        "latency": lambda: seen,
        "clocks": lambda: {"75e…0fc": (2.5, 0.01)},
        "ports": lambda: [PortRow("eth0", is_up=True, mtu=1500, counts=DeviceCounts(1, 1, 1, 1, 1, 1, 1, 1))],
        "topics": lambda: [TopicCounts("75e…0fc", "out", 1, 1, 1, 1)],
        "health": Health,
    }
    assert set(sources) == set(Sources.__dataclass_fields__)
    families = text_string_to_metric_families(Metrics(Sources(**sources)).text())
    samples = [sample for family in families for sample in family.samples]
    return {
        each.name: {label for other in samples if other.name == each.name for label in other.labels} for each in samples
    }


def rules() -> list[dict[str, Any]]:
    """Return the alert rules."""
    groups: Any = yaml.safe_load((FOLDER / "gdp-alerts.yml").read_text(encoding="utf-8"))
    return [rule for group in groups["groups"] for rule in group["rules"]]


def panels() -> list[dict[str, Any]]:
    """Return the panels of the dashboard."""
    dashboard: Any = json.loads((FOLDER / "grafana-gdp.json").read_text(encoding="utf-8"))
    every: list[dict[str, Any]] = dashboard["panels"]
    return every


def expressions() -> Iterator[tuple[str, str]]:
    """Yield every expression, and the texts that use its labels."""
    for rule in rules():
        yield rule["expr"], " ".join(rule["annotations"].values())
    for panel in panels():
        for target in panel.get("targets", ()):
            yield target["expr"], target["legendFormat"]
    dashboard: Any = json.loads((FOLDER / "grafana-gdp.json").read_text(encoding="utf-8"))
    for variable in dashboard["templating"]["list"]:
        yield variable.get("definition", ""), ""


def test_every_metric_that_is_asked_for_is_exported_with_these_labels() -> None:
    known = exported()
    for expression, text in expressions():
        names = set(re.findall(r"\bgdp_\w+", expression))
        assert names <= known.keys(), expression
        labels = set().union(*(known[name] for name in names)) | BY_PROMETHEUS
        grouped = ",".join(re.findall(r"\bby \(([^)]*)\)", expression)).replace(" ", "").split(",")
        matched = [label for inside in re.findall(r"{([^}]*)}", expression) for label in re.findall(r"(\w+)=", inside)]
        shown = re.findall(r"{{ ?(?:\$labels\.)?(\w+) ?}}", text)
        assert {each for each in (*grouped, *matched, *shown) if each} <= labels, (expression, text)


def test_every_exported_metric_is_on_the_dashboard_or_watched() -> None:
    asked = set(re.findall(r"\bgdp_\w+", " ".join(expression for expression, _ in expressions())))
    known = {re.sub(r"_(bucket|count|sum|created)$", "", name) for name in exported() if not name.endswith("_created")}
    assert known <= {re.sub(r"_bucket$", "", name) for name in asked}


def test_panels_have_their_own_ids_and_do_not_overlap() -> None:
    every = panels()
    assert len({each["id"] for each in every}) == len(every)
    taken = [
        (x, y)
        for each in every
        for x in range(each["gridPos"]["x"], each["gridPos"]["x"] + each["gridPos"]["w"])
        for y in range(each["gridPos"]["y"], each["gridPos"]["y"] + each["gridPos"]["h"])
    ]
    assert len(taken) == len(set(taken))
    assert max(x for x, _ in taken) < 24


def test_every_rule_says_what_is_wrong_and_how_bad() -> None:
    for rule in rules():
        assert set(rule["annotations"]) == {"summary", "description"}
        assert rule["labels"]["severity"] in ("warning", "critical")


def test_ports_are_those_of_the_ring() -> None:
    from lab.credentials import METRICS_PORTS

    text = (FOLDER / "prometheus.yml").read_text(encoding="utf-8")
    assert all(f"127.0.0.1:{port}" in text for port in METRICS_PORTS.values())


@needs_promtool
def test_promtool_accepts_configuration_and_rules() -> None:
    done = subprocess.run(
        ["promtool", "check", "config", FOLDER / "prometheus.yml"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(rules())} rules found" in done.stdout


@needs_promtool
def test_alerts_fire_when_they_should(tmp_path: Path) -> None:
    shutil.copy(FOLDER / "gdp-alerts.yml", tmp_path)
    shutil.copy(ROOT / "tests" / "alerts_test.yml", tmp_path)
    done = subprocess.run(
        ["promtool", "test", "rules", tmp_path / "alerts_test.yml"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
