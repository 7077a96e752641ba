"""Probes of a node: which state makes which of them fail, and how they are asked."""

from __future__ import annotations

import json
from collections.abc import Iterator
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from gdp.telemetry.health import LIVE_S, PROBES, Health, probe
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import Sources

_NOW_S = 100.0
_WAITS = Health(_NOW_S, ("no neighbour on eth0: no answer there",))


@pytest.mark.parametrize(
    ("health", "failing"),
    [
        (Health(_NOW_S), set()),
        (Health(), {"/healthz", "/readyz"}),  # it starts
        (_WAITS, {"/healthz", "/readyz"}),
        (Health(_NOW_S - LIVE_S - 1), {"/healthz", "/livez", "/readyz"}),  # its loop hangs
    ],
)
def test_a_probe_fails_for_what_it_is_about(health: Health, failing: set[str]) -> None:
    assert {each for each in PROBES if not probe(each, health, _NOW_S)[0]} == failing


def test_a_probe_says_what_the_node_waits_for() -> None:
    _, body = probe("/readyz", _WAITS, _NOW_S + 1)
    said = json.loads(body)
    assert said == {
        "live": True,
        "ready": False,
        "loop_age_s": 1.0,
        "waiting": ["no neighbour on eth0: no answer there"],
    }


@pytest.fixture
def port() -> Iterator[int]:
    metrics = Metrics(Sources(health=lambda: _WAITS))
    yield metrics.serve(0)
    metrics.close()


def test_probes_and_metrics_share_a_port(port: int) -> None:
    with pytest.raises(HTTPError) as refused:
        urlopen(f"http://127.0.0.1:{port}/readyz?verbose", timeout=2)
    assert refused.value.code == 503
    assert "no neighbour on eth0" in json.load(refused.value)["waiting"][0]
    refused.value.close()
    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=2) as metrics:
        assert metrics.status == 200


def test_a_node_without_a_loop_of_its_own_has_no_probes() -> None:
    metrics = Metrics(Sources())
    try:
        with pytest.raises(HTTPError) as refused:
            urlopen(f"http://127.0.0.1:{metrics.serve(0)}/healthz", timeout=2)
        assert refused.value.code == 404
        refused.value.close()
    finally:
        metrics.close()
