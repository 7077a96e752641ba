"""Metrics of a node as Prometheus text, on the loopback address only.

I/O. Nodes count in plain attributes, which a scrape reads, so a metric costs the hot path nothing. A node states which
metrics it has; their names are the same for all nodes.
Source: Prometheus text exposition format, version 0.0.4.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import Final, TypeVar

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from gdp.errors import DropReason, LocalError
from gdp.http_server import Answer, HttpServer
from gdp.intervals import CONNECT_S, Rate
from gdp.names import NAME_BYTES, Name
from gdp.telemetry.health import PROBES, Health, probe
from gdp.telemetry.sources import (
    Counts,
    EntryCounts,
    Gauge,
    Histogram,
    NeighbourRow,
    PortRow,
    Sources,
    TopicCounts,
)
from gdp.token_bucket import TokenBucket

_CONNECTIONS_MAX: Final = 4
_BACKLOG: Final = 128
_ANSWERS_RATE: Final = Rate(20.0, burst=20.0)  # a few ms each; a scraper polls every few seconds
_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_JSON: Final = "application/json"


_ANY: Final = "any"  # an entry for every source
_DEVICE_COUNTS: Final = {
    "frames": "Frames at the device, of all protocols",
    "bytes": "Their bytes",
    "errors": "Frames with errors at the device",
    "drops": "Frames that the device or its queue dropped",
}
_Family = TypeVar("_Family", CounterMetricFamily, GaugeMetricFamily)


class Metrics(Collector):
    """One node's metrics, in their own registry."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        self._server: HttpServer | None = None

    def describe(self) -> list[Metric]:
        """Return nothing, so that registration reads no source."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read every source."""
        of = self._sources
        yield from _counter("gdp_frames", "Frames by direction", "direction", of.frames)
        if (drops := of.drops) is not None:
            by_label = lambda: {reason.label: drops().get(reason, 0) for reason in DropReason}  # noqa: E731
            yield from _counter("gdp_drops", "What went no further, by reason", "reason", by_label)
        yield from _gauge("gdp_table_entries", "Entries of the forwarding table", of.table_entries)
        yield from _entries(of.entries)
        yield from _gauge("gdp_parked_frames", "Frames waiting for an answer", of.pending_frames)
        yield from _counter("gdp_rib_answers", "Answers by what they said", "answer", of.rib_answers)
        yield from _counter("gdp_rib_refusals", "Refusals by reason", "reason", of.rib_refusals)
        yield from _counter("gdp_messages", "Whole messages by direction", "direction", of.messages)
        yield from _counter("gdp_message_bytes", "Their bytes before sealing", "direction", of.message_bytes)
        yield from _counter("gdp_repairs", "Lost parts by what happened to them", "step", of.repairs)
        yield from _counter("gdp_lost_messages", "Messages lost on their way here, by reason", "reason", of.lost)
        text = "Messages from here that some reader did not get, by reason"
        yield from _counter("gdp_unconfirmed_messages", text, "reason", of.unconfirmed)
        yield from _counter("gdp_proxy_faults", "What was not carried as it should be, by fault", "fault", of.faults)
        yield from _counter("gdp_calls", "Calls of several servers by what came of it", "event", of.calls)
        yield from _gauges("gdp_waiting", "1: the node makes no progress for this reason", "reason", of.waiting)
        if of.links is not None:
            yield from _links(of.links())
        if of.clocks is not None:
            yield from _clocks(of.clocks())
        if of.ports is not None:
            yield from _ports(of.ports())
        if of.topics is not None:
            yield from _topics(of.topics())
        yield from _gauges("gdp_two_paths", "Flows that want two paths, by what they have", "paths", of.two_paths)
        if of.clashes is not None:
            yield CounterMetricFamily(
                "gdp_identity_clashes", "Signs of another node with this identity", value=of.clashes()
            )
        if of.latency is not None:
            text = "One-way latency of messages, corrected by the offset of the sender's clock where that is known"
            yield _histogram("gdp_latency_seconds", text, of.latency())

    def text(self) -> str:
        """Return the text of a scrape."""
        return generate_latest(self._registry).decode()

    def serve(self, port: int) -> int:
        """Serve scrapes on 127.0.0.1, within the bounds of ``scraping``; return the port (0: the system chooses).

        Raises:
            LocalError: it is served already, or the port is in use.
        """
        if self._server is not None:
            raise LocalError("metrics are served already")
        try:
            self._server = scrape_server(port, lambda: generate_latest(self._registry), self._sources.health)
        except OSError as error:
            raise LocalError(f"metrics port {port}: {error.strerror}") from error
        return self._server.port

    def close(self) -> None:
        """Stop serving, and return when the port is free again."""
        if self._server is None:
            return
        self._server.close()
        self._server = None


def _family(
    kind: type[_Family], name: str, text: str, labels: Sequence[str], samples: Iterable[tuple[Sequence[str], float]]
) -> _Family:
    """Return a metric with its samples, each as label values and number."""
    family = kind(name, text, labels=labels)
    for values, number in samples:
        family.add_metric(values, number)
    return family


def _counter(name: str, text: str, label: str, source: Counts | None) -> Iterator[Metric]:
    if source is not None:
        counts = list(source().items())  # a copy, because the node continues to count
        yield _family(CounterMetricFamily, name, text, [label], (([value], count) for value, count in counts))


def _entries(source: EntryCounts | None) -> Iterator[Metric]:
    """Return entries under short names: a whole name would let every reader of a graph request the topic."""
    if source is None:
        return
    sums: dict[tuple[str, str], tuple[int, int]] = {}
    for key, (count, size) in source().items():
        names = Name(key[:NAME_BYTES]).short, Name(key[NAME_BYTES:]).short if len(key) > NAME_BYTES else _ANY
        before = sums.get(names, (0, 0))
        sums[names] = before[0] + count, before[1] + size
    labels, text = ["destination", "source"], "Frames forwarded by the busiest entries"
    for name, help_text, at in (("gdp_entry_frames", text, 0), ("gdp_entry_bytes", "Their bytes", 1)):
        yield _family(CounterMetricFamily, name, help_text, labels, ((ends, sums[ends][at]) for ends in sums))


def _links(rows: Sequence[NeighbourRow]) -> Iterator[Metric]:
    labels, ends = ["port", "neighbour"], [((row.port, row.name.short), row) for row in rows]
    text, costs = "Cost of the link to a neighbour", [(at, row.cost) for at, row in ends]
    yield _family(GaugeMetricFamily, "gdp_link_cost", text, labels, costs)
    rtts = [(at, row.rtt_s) for at, row in ends if row.rtt_s is not None]
    yield _family(GaugeMetricFamily, "gdp_link_rtt_seconds", "Its smoothed round-trip time", labels, rtts)
    losses = [((*at, way), loss) for at, row in ends for way, loss in (("in", row.loss_in), ("out", row.loss_out))]
    yield _family(GaugeMetricFamily, "gdp_link_loss", "Share of keepalives lost", [*labels, "direction"], losses)


def _clocks(rows: Mapping[str, tuple[float, float]]) -> Iterator[Metric]:
    texts = "What the wall clock of another member is ahead of ours", "How wrong that may be"
    for at, (name, text) in enumerate(zip(("gdp_clock_offset_seconds", "gdp_clock_bound_seconds"), texts, strict=True)):
        yield _family(GaugeMetricFamily, name, text, ["peer"], (([peer], row[at]) for peer, row in rows.items()))


def _ports(rows: Sequence[PortRow]) -> Iterator[Metric]:
    text, up = "1: the device is on and has a carrier", [([row.port], int(row.is_up)) for row in rows]
    yield _family(GaugeMetricFamily, "gdp_port_up", text, ["port"], up)
    text, mtus = "Bytes of a frame after the Ethernet header", [([row.port], row.mtu) for row in rows]
    yield _family(GaugeMetricFamily, "gdp_port_mtu_bytes", text, ["port"], mtus)
    counted = [(row.port, row.counts) for row in rows if row.counts is not None]
    for what, text in _DEVICE_COUNTS.items():
        samples = [([port, way], getattr(counts, f"{what}_{way}")) for port, counts in counted for way in ("in", "out")]
        yield _family(CounterMetricFamily, f"gdp_port_{what}", text, ["port", "direction"], samples)


def _topics(rows: Sequence[TopicCounts]) -> Iterator[Metric]:
    for name, text, field in (
        ("gdp_topic_messages", "Messages of a topic that is carried now", "messages"),
        ("gdp_topic_bytes", "Their bytes in ROS's wire form", "size"),
        ("gdp_topic_lost_messages", "Messages of it that were lost", "lost"),
    ):
        samples = [([row.topic, row.direction], getattr(row, field)) for row in rows]
        yield _family(CounterMetricFamily, name, text, ["topic", "direction"], samples)
    readers = [([row.topic], row.readers) for row in rows if row.readers is not None]
    yield _family(GaugeMetricFamily, "gdp_topic_readers", "Its readers on the overlay", ["topic"], readers)


def _gauge(name: str, text: str, source: Gauge | None) -> Iterator[Metric]:
    if source is not None:
        yield GaugeMetricFamily(name, text, value=source())


def _gauges(name: str, text: str, label: str, source: Counts | None) -> Iterator[Metric]:
    if source is not None:
        yield _family(GaugeMetricFamily, name, text, [label], (([value], each) for value, each in source().items()))


def _histogram(name: str, text: str, seen: Histogram) -> Metric:
    ends = [*map(repr, seen.bounds_s), "+Inf"]
    buckets = list(zip(ends, accumulate(seen.counts), strict=True))
    return HistogramMetricFamily(name, text, buckets=buckets, sum_value=seen.total_s)


def scrape_server(port: int, text: Callable[[], bytes], health: Callable[[], Health] | None = None) -> HttpServer:
    """Serve the present text; the paths of ``PROBES`` give the state of the node instead.

    Args:
        port: of 127.0.0.1; 0: the system chooses.
        text: called in the server's thread, once for each response.
        health: called for each probe; None: the node has no probes, and they get 404.

    Raises:
        OSError: the port is in use.
    """
    answers = TokenBucket(*_ANSWERS_RATE)

    def answer(path: str) -> Answer:
        """Return the response for a path."""
        if not answers.spend(time.monotonic()):
            return Answer("503 Service Unavailable")
        if path not in PROBES:
            return Answer("200 OK", text(), _TYPE)
        if health is None:
            return Answer("404 Not Found")
        is_good, state = probe(path, health(), time.monotonic())
        return Answer("200 OK" if is_good else "503 Service Unavailable", state, _JSON)

    listener = socket.create_server(("127.0.0.1", port), backlog=_BACKLOG)
    return HttpServer(listener, answer, name="metrics", connections=_CONNECTIONS_MAX, timeout_s=CONNECT_S)
