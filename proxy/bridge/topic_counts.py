"""Topics of a bridge as rows of metrics.

It reads counters only. A scrape calls it in its own thread, and the flows continue to count meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterable

from gdp.telemetry.sources import TopicCounts
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.imported_topic import ImportedTopic

__all__ = ["topic_counts"]


def topic_counts(flows: Iterable[tuple[FlowSpec, object]], *, has_names: bool) -> list[TopicCounts]:
    """Return one row for each topic and direction.

    Args:
        has_names: label rows with local ROS names; otherwise with short overlay names, which say nothing to others.
    """
    rows: dict[tuple[str, str], TopicCounts] = {}
    for flow_spec, flow in flows:
        label = flow_spec.local if has_names else flow_spec.name.short
        if isinstance(flow, ExposedTopic):
            row = _outgoing(label, flow)
        elif isinstance(flow, ImportedTopic):
            row = TopicCounts(label, "in", flow.stats.received, flow.stats.received_bytes, flow.stats.lost, None)
        else:
            continue
        known = rows.get((label, row.direction))
        rows[label, row.direction] = row if known is None else _sum(known, row)
    return list(rows.values())


def _outgoing(label: str, flow: ExposedTopic) -> TopicCounts:
    messages, size, publisher = sum(flow.published.values()), sum(flow.published_bytes.values()), flow.publisher
    lost = 0 if publisher is None else publisher.losses.total
    return TopicCounts(label, "out", messages, size, lost, 0 if publisher is None else publisher.readers)


def _sum(one: TopicCounts, other: TopicCounts) -> TopicCounts:
    """Return the row of two topics that look alike: two names of one short form, or a topic of two graphs."""
    readers = None if one.readers is None else one.readers + (other.readers or 0)
    return one._replace(
        messages=one.messages + other.messages,
        size=one.size + other.size,
        lost=one.lost + other.lost,
        readers=readers,
    )
