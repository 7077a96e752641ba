"""Metrics of a node as Prometheus text, on the loopback address only.

I/O. Nodes count in plain attributes, which a scrape reads, so a metric costs the hot path nothing. A node states which
metrics it has; their names are the same for all nodes.
Source: Prometheus text exposition format, version 0.0.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import Final

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from gdp.errors import DropReason, LocalError
from gdp.http_server import HttpServer
from gdp.names import NAME_BYTES, Name
from gdp.telemetry.scraping import scrape_server
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

__all__ = ["Metrics"]

_ANY: Final = "any"  # an entry for every source


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
            yield _histogram("gdp_latency_seconds", "One-way latency of messages", of.latency())

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


def _counter(name: str, text: str, label: str, source: Counts | None) -> Iterator[Metric]:
    if source is not None:
        family = CounterMetricFamily(name, text, labels=[label])
        for value, count in list(source().items()):  # a copy, because the node continues to count
            family.add_metric([value], count)
        yield family


def _entries(source: EntryCounts | None) -> Iterator[Metric]:
    """Return entries under short names: a whole name would let every reader of a graph request the topic."""
    if source is None:
        return
    labels = ["destination", "source"]
    frames = CounterMetricFamily("gdp_entry_frames", "Frames forwarded by the busiest entries", labels=labels)
    sizes = CounterMetricFamily("gdp_entry_bytes", "Their bytes", labels=labels)
    sums: dict[tuple[str, str], tuple[int, int]] = {}
    for key, (count, size) in source().items():
        names = Name(key[:NAME_BYTES]).short, Name(key[NAME_BYTES:]).short if len(key) > NAME_BYTES else _ANY
        before = sums.get(names, (0, 0))
        sums[names] = before[0] + count, before[1] + size
    for names, (count, size) in sums.items():
        frames.add_metric(names, count)
        sizes.add_metric(names, size)
    yield frames
    yield sizes


def _links(rows: Sequence[NeighbourRow]) -> Iterator[Metric]:
    labels = ["port", "neighbour"]
    costs = GaugeMetricFamily("gdp_link_cost", "Cost of the link to a neighbour", labels=labels)
    rtts = GaugeMetricFamily("gdp_link_rtt_seconds", "Its smoothed round-trip time", labels=labels)
    losses = GaugeMetricFamily("gdp_link_loss", "Share of keepalives lost", labels=[*labels, "direction"])
    for row in rows:
        ends = [row.port, row.name.short]
        costs.add_metric(ends, row.cost)
        if row.rtt_s is not None:
            rtts.add_metric(ends, row.rtt_s)
        losses.add_metric([*ends, "in"], row.loss_in)
        losses.add_metric([*ends, "out"], row.loss_out)
    yield costs
    yield rtts
    yield losses


def _ports(rows: Sequence[PortRow]) -> Iterator[Metric]:
    is_up = GaugeMetricFamily("gdp_port_up", "1: the device is on and has a carrier", labels=["port"])
    mtus = GaugeMetricFamily("gdp_port_mtu_bytes", "Bytes of a frame after the Ethernet header", labels=["port"])
    labels = ["port", "direction"]
    frames = CounterMetricFamily("gdp_port_frames", "Frames at the device, of all protocols", labels=labels)
    sizes = CounterMetricFamily("gdp_port_bytes", "Their bytes", labels=labels)
    errors = CounterMetricFamily("gdp_port_errors", "Frames with errors at the device", labels=labels)
    drops = CounterMetricFamily("gdp_port_drops", "Frames that the device or its queue dropped", labels=labels)
    for row in rows:
        is_up.add_metric([row.port], int(row.is_up))
        mtus.add_metric([row.port], row.mtu)
        if (counts := row.counts) is None:
            continue
        for family, (come, gone) in (
            (frames, (counts.frames_in, counts.frames_out)),
            (sizes, (counts.bytes_in, counts.bytes_out)),
            (errors, (counts.errors_in, counts.errors_out)),
            (drops, (counts.drops_in, counts.drops_out)),
        ):
            family.add_metric([row.port, "in"], come)
            family.add_metric([row.port, "out"], gone)
    yield from (is_up, mtus, frames, sizes, errors, drops)


def _topics(rows: Sequence[TopicCounts]) -> Iterator[Metric]:
    labels = ["topic", "direction"]
    messages = CounterMetricFamily("gdp_topic_messages", "Messages of a topic that is carried now", labels=labels)
    sizes = CounterMetricFamily("gdp_topic_bytes", "Their bytes in ROS's wire form", labels=labels)
    lost = CounterMetricFamily("gdp_topic_lost_messages", "Messages of it that were lost", labels=labels)
    readers = GaugeMetricFamily("gdp_topic_readers", "Its readers on the overlay", labels=["topic"])
    for row in rows:
        messages.add_metric([row.topic, row.direction], row.messages)
        lost.add_metric([row.topic, row.direction], row.lost)
        sizes.add_metric([row.topic, row.direction], row.size)
        if row.readers is not None:
            readers.add_metric([row.topic], row.readers)
    yield from (messages, sizes, lost, readers)


def _gauge(name: str, text: str, source: Gauge | None) -> Iterator[Metric]:
    if source is not None:
        yield GaugeMetricFamily(name, text, value=source())


def _gauges(name: str, text: str, label: str, source: Counts | None) -> Iterator[Metric]:
    if source is not None:
        family = GaugeMetricFamily(name, text, labels=[label])
        for value, number in source().items():
            family.add_metric([value], number)
        yield family


def _histogram(name: str, text: str, seen: Histogram) -> Metric:
    ends = [*map(repr, seen.bounds_s), "+Inf"]
    buckets = list(zip(ends, accumulate(seen.counts), strict=True))
    return HistogramMetricFamily(name, text, buckets=buckets, sum_value=seen.total_s)
