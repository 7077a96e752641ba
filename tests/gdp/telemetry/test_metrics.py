"""Metrics of nodes: names, labels and scrapes."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace
from urllib.request import urlopen

import pytest

from gdp.errors import DROP_COUNTERS, DropReason, LocalError
from gdp.names import Name
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import DeviceCounts, Histogram, NeighbourRow, PortRow, Sources, TopicCounts


def drops(**counts: int) -> list[int]:
    listed = [0] * DROP_COUNTERS
    for name, count in counts.items():
        listed[DropReason[name]] = count
    return listed


@pytest.fixture
def metrics() -> Iterator[Metrics]:
    made = Metrics(Sources(frames=lambda: {"in": 3}))
    yield made
    made.close()


def test_frames_are_counted_by_direction() -> None:
    text = Metrics(Sources(frames=lambda: {"in": 3, "out": 2})).text()
    assert 'gdp_frames_total{direction="in"} 3.0' in text
    assert 'gdp_frames_total{direction="out"} 2.0' in text


def test_drops_are_counted_by_reason_and_those_that_did_not_occur_are_zero() -> None:
    counts = {DropReason.TRUNCATED: 3, DropReason.NO_ROUTE: 5}
    text = Metrics(Sources(drops=lambda: counts)).text()
    assert 'gdp_drops_total{reason="truncated"} 3.0' in text
    assert 'gdp_drops_total{reason="no-route"} 5.0' in text
    assert text.count("gdp_drops_total{") == len(DropReason)


def test_every_number_of_a_node_has_its_name() -> None:
    text = Metrics(
        Sources(
            table_entries=lambda: 7,
            pending_frames=lambda: 8,
            rib_answers=lambda: {"found": 1},
            rib_refusals=lambda: {"expired": 2},
            messages=lambda: {"in": 3},
            message_bytes=lambda: {"in": 4},
            repairs=lambda: {"asked": 5},
        )
    ).text()
    for line in (
        "gdp_table_entries 7.0",
        "gdp_parked_frames 8.0",
        'gdp_rib_answers_total{answer="found"} 1.0',
        'gdp_rib_refusals_total{reason="expired"} 2.0',
        'gdp_messages_total{direction="in"} 3.0',
        'gdp_message_bytes_total{direction="in"} 4.0',
        'gdp_repairs_total{step="asked"} 5.0',
    ):
        assert line in text.splitlines()


def test_a_number_that_a_node_does_not_have_is_not_named() -> None:
    assert Metrics(Sources()).text() == ""


def test_a_histogram_counts_a_duration_in_every_bucket_from_its_own_on() -> None:
    seen = Histogram((0.1, 0.2))
    for duration_s in (0.05, 0.1, 0.15, 9.0):
        seen.observe(duration_s)
    assert seen.counts == [2, 1, 1]
    text = Metrics(Sources(latency=lambda: seen)).text()
    assert 'gdp_latency_seconds_bucket{le="0.1"} 2.0' in text
    assert 'gdp_latency_seconds_bucket{le="0.2"} 3.0' in text
    assert 'gdp_latency_seconds_bucket{le="+Inf"} 4.0' in text
    assert "gdp_latency_seconds_count 4.0" in text
    assert "gdp_latency_seconds_sum 9.3" in text


def test_each_scrape_reads_fresh_values() -> None:
    counts = {"in": 1}
    metrics = Metrics(Sources(frames=lambda: counts))
    before = metrics.text()
    counts["in"] = 2
    assert before != metrics.text()


def test_making_metrics_asks_no_source() -> None:
    def never() -> dict[str, int]:
        raise AssertionError("asked too early")

    Metrics(Sources(frames=never))


def test_a_scrape_over_http_gets_the_text(metrics: Metrics) -> None:
    port = metrics.serve(0)
    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        assert answer.read().decode() == metrics.text()


def test_only_this_machine_can_scrape(metrics: Metrics) -> None:
    port = metrics.serve(0)
    with socket.socket() as other, pytest.raises(ConnectionRefusedError):
        other.connect(("127.0.0.2", port))


def test_closing_frees_the_port(metrics: Metrics) -> None:
    port = metrics.serve(0)
    metrics.close()
    assert metrics.serve(port) == port


def test_a_taken_port_is_said_plainly(metrics: Metrics) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(LocalError, match="metrics port"):
            metrics.serve(taken.getsockname()[1])


def test_serving_twice_is_our_own_fault(metrics: Metrics) -> None:
    metrics.serve(0)
    with pytest.raises(LocalError):
        metrics.serve(0)


def test_entries_are_reported_by_short_names_and_those_that_look_alike_together() -> None:
    one, other = bytes(range(32)), bytes(range(16)) + b"x" * 14 + bytes([30, 31])
    assert Name(one).short == Name(other).short
    text = Metrics(Sources(entries=lambda: {one: (3, 300), other: (1, 50), one + other: (2, 200)})).text()
    short = Name(one).short
    assert f'gdp_entry_frames_total{{destination="{short}",source="any"}} 4.0' in text
    assert f'gdp_entry_bytes_total{{destination="{short}",source="{short}"}} 200.0' in text
    assert one.hex() not in text


def test_each_link_shows_its_cost_its_round_trip_time_and_its_loss() -> None:
    slow = NeighbourRow(
        port="wg0", name=Name(b"\xab" * 32), cost=30, rtt_s=0.02, rtt_var_s=0.001, loss_in=0.25, loss_out=0.5
    )
    text = Metrics(Sources(links=lambda: [slow, replace(slow, port="wg1", rtt_s=None, cost=100)])).text()
    for line in (
        'gdp_link_cost{neighbour="aba…bab",port="wg0"} 30.0',
        'gdp_link_cost{neighbour="aba…bab",port="wg1"} 100.0',
        'gdp_link_rtt_seconds{neighbour="aba…bab",port="wg0"} 0.02',
        'gdp_link_loss{direction="in",neighbour="aba…bab",port="wg0"} 0.25',
        'gdp_link_loss{direction="out",neighbour="aba…bab",port="wg0"} 0.5',
    ):
        assert line in text.splitlines()
    assert text.count("gdp_link_rtt_seconds{") == 1


def test_each_port_shows_its_state_and_what_its_device_counted() -> None:
    counts = DeviceCounts(5, 6, 500, 600, 0, 1, 2, 0)
    ports = [PortRow("eth0", is_up=True, mtu=1500, counts=counts), PortRow("eth1", is_up=False, mtu=0, counts=None)]
    lines = Metrics(Sources(ports=lambda: ports)).text().splitlines()
    for line in (
        'gdp_port_up{port="eth0"} 1.0',
        'gdp_port_up{port="eth1"} 0.0',
        'gdp_port_mtu_bytes{port="eth0"} 1500.0',
        'gdp_port_frames_total{direction="in",port="eth0"} 5.0',
        'gdp_port_bytes_total{direction="out",port="eth0"} 600.0',
        'gdp_port_errors_total{direction="out",port="eth0"} 1.0',
        'gdp_port_drops_total{direction="in",port="eth0"} 2.0',
    ):
        assert line in lines
    assert not [line for line in lines if line.startswith("gdp_port_frames") and "eth1" in line]


def test_each_topic_shows_its_messages_losses_and_readers() -> None:
    topics = [TopicCounts("/scan", "out", 10, 800, 1, 2), TopicCounts("/scan", "in", 4, 320, 0, None)]
    lines = Metrics(Sources(topics=lambda: topics)).text().splitlines()
    for line in (
        'gdp_topic_messages_total{direction="out",topic="/scan"} 10.0',
        'gdp_topic_messages_total{direction="in",topic="/scan"} 4.0',
        'gdp_topic_bytes_total{direction="out",topic="/scan"} 800.0',
        'gdp_topic_lost_messages_total{direction="out",topic="/scan"} 1.0',
        'gdp_topic_readers{topic="/scan"} 2.0',
    ):
        assert line in lines
