"""Stored latencies: measured once in a lifetime, each with its source."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from fog.latency.config import LatencyConfig, ProbeEndpoint
from fog.latency.known import Latencies
from fog.latency.probe import Probed

CONFIG = LatencyConfig(endpoints={"near": "127.0.0.1:1", "*": "udp://{region}.example:7"}, lifetime_s=100)


class Probes:
    """Probe with prepared responses that records the requests."""

    def __init__(self, **answers: Probed) -> None:
        self.answers = answers
        self.asked: list[str] = []

    def __call__(self, endpoints: Mapping[str, ProbeEndpoint], timeout_s: float) -> dict[str, Probed]:
        del timeout_s
        self.asked += [f"{region} {endpoint.to_text()}" for region, endpoint in endpoints.items()]
        return {region: self.answers[region] for region in endpoints}


@pytest.fixture
def probes() -> Probes:
    return Probes(near=Probed(1.5), far=Probed(None, "Connection refused"))


def test_a_region_is_measured_once_in_its_lifetime_by_any_process(tmp_path: Path, probes: Probes) -> None:
    Latencies(tmp_path, CONFIG, {}, probes).refresh(["near", "near"], 1_000.0)
    Latencies(tmp_path, CONFIG, {}, probes).refresh(["near"], 1_049.0)
    assert probes.asked == ["near tcp://127.0.0.1:1"]
    Latencies(tmp_path, CONFIG, {}, probes).refresh(["near"], 1_050.0)
    assert len(probes.asked) == 2


def test_what_is_known_says_where_it_comes_from(tmp_path: Path, probes: Probes) -> None:
    known = Latencies(tmp_path, CONFIG, {"stated": 7.0}, probes)
    assert known.lookup(["near"], 1_000.0)["near"].source == "not measured yet: tcp://127.0.0.1:1"
    known.refresh(["near", "far", "stated"], 1_000.0)
    reported = {name: (each.ms, each.source) for name, each in known.lookup(["near", "far", "stated"], 1_030.0).items()}
    assert reported == {
        "near": (1.5, "measured 30s ago, tcp://127.0.0.1:1"),
        "far": (None, "unreachable 30s ago: udp://far.example:7: Connection refused"),
        "stated": (7.0, "latency_ms of fog.yaml"),
    }
    assert known.ms(["near", "far", "stated"], 1_030.0) == {"near": 1.5, "stated": 7.0}


def test_a_measurement_past_its_lifetime_is_worth_nothing(tmp_path: Path, probes: Probes) -> None:
    known = Latencies(tmp_path, CONFIG, {}, probes)
    known.refresh(["near"], 1_000.0)
    assert known.ms(["near"], 1_100.0) == {"near": 1.5}
    assert known.lookup(["near"], 1_101.0)["near"].source.startswith("too old")


def test_an_unreachable_endpoint_is_asked_again_after_a_minute(tmp_path: Path, probes: Probes) -> None:
    known = Latencies(tmp_path, CONFIG, {}, probes)
    for now_s in (1_000.0, 1_049.0, 1_060.0):
        known.refresh(["far"], now_s)
    assert len(probes.asked) == 2


def test_another_endpoint_for_a_region_is_another_measurement(tmp_path: Path, probes: Probes) -> None:
    Latencies(tmp_path, CONFIG, {}, probes).refresh(["near"], 1_000.0)
    other = LatencyConfig(endpoints={"near": "127.0.0.1:2"})
    assert Latencies(tmp_path, other, {}, probes).lookup(["near"], 1_001.0)["near"].ms is None


def test_a_cache_that_cannot_be_read_is_an_empty_one(tmp_path: Path, probes: Probes) -> None:
    (tmp_path / "latency.json").write_text('{"near": {"ms": 3}}', encoding="utf-8")
    assert Latencies(tmp_path, CONFIG, {}, probes).ms(["near"], 1_000.0) == {}


def test_every_region_of_aws_has_an_endpoint_unless_others_are_stated() -> None:
    found = LatencyConfig().for_aws().endpoint("eu-west-1")
    assert found == ProbeEndpoint("tcp", "ec2.eu-west-1.amazonaws.com", 443)
    assert CONFIG.for_aws() == CONFIG
