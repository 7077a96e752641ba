"""Flows of a bridge as others read them: rows of metrics, rows of the control command ``topics``, fields of a snapshot.

It reads counters only. A scrape calls it in its own thread, and the flows continue to count meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Final

from gdp.client.participant import Participant, Topic
from gdp.message.loss import LossReason
from gdp.state.snapshot import short_id
from gdp.state.topic_rows import Direction, TopicRow, held_row
from gdp.telemetry.sources import TopicCounts
from proxy.bridge.bridge import Flow
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.exclusive_control import ExclusiveControl
from proxy.bridge.exposed_service import ExposedService
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.imported_service import ImportedService
from proxy.bridge.imported_topic import ImportedTopic
from proxy.bridge.node_flow import ExposedNodes, ImportedNodes

_HIDDEN: Final = "/_gdp_proxy"  # presence topics of proxies
_SERVERS_MAX: Final = 64


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


def flow_rows(flows: Iterable[tuple[FlowSpec, Flow]], held: Iterable[Topic], member: Participant) -> Iterator[TopicRow]:
    """Yield a row for each flow, then one for each delegation whose name has none."""
    seen = set[str]()
    for spec, flow in flows:
        if spec.local.startswith(_HIDDEN):
            continue
        row = _row(spec, flow, member)
        seen.add(row.name)
        yield row
    for topic in held:
        if topic.name.to_text() not in seen:
            yield held_row(topic)


def _row(spec: FlowSpec, flow: Flow, member: Participant) -> TopicRow:
    row = partial(TopicRow, name=spec.name.to_text(), topic=spec.local, kind=spec.rule.kind, type=spec.type_name)
    if isinstance(flow, ExposedTopic):
        losses = None if flow.publisher is None else flow.publisher.losses.counts
        return row(
            direction=Direction.OUT,
            messages=flow.published.total(),
            bytes=flow.published_bytes.total(),
            lost=0 if losses is None else losses.total() - losses[LossReason.NO_READER] - losses[LossReason.LIFESPAN],
            late=0 if losses is None else losses[LossReason.LIFESPAN],
            publishers=flow.local_publishers,
            readers=0 if flow.publisher is None else flow.publisher.readers,
        )
    if isinstance(flow, ImportedTopic):
        flow.count_losses()
        late = flow.stats.losses.counts[LossReason.LIFESPAN]
        return row(
            direction=Direction.IN,
            messages=flow.stats.received,
            bytes=flow.stats.received_bytes,
            lost=flow.stats.lost - late,
            late=late,
            publishers=len(member.subscriptions.writer_proxies_of(spec.name)),
            readers=flow.local_readers,
        )
    if isinstance(flow, ExposedService | ExposedNodes):
        return row(
            direction=Direction.OUT,
            messages=flow.requests,
            bytes=flow.request_bytes,
            publishers=1,
            readers=len(member.services.connected_peers(spec.name)),
        )
    if isinstance(flow, ImportedNodes):
        return row(direction=Direction.IN, publishers=len(member.services.peers(spec.name)))
    return row(
        direction=Direction.IN,
        messages=flow.requests,
        bytes=flow.request_bytes,
        lost=flow.failed,
        late=flow.late,
        publishers=len(flow.servers),
    )


def control_row(flow: ImportedTopic, control: ExclusiveControl, now_s: float) -> dict[str, object]:
    """Return who holds the control of a topic."""
    holder = control.holder
    return {
        "state": control.state(now_s).value,
        "holder": "" if holder is None else flow.publishers.get(holder) or holder.short,
        "peer": b"" if holder is None else holder,
        "refused": control.refused,
    }


def flow_fields(spec: FlowSpec, flow: object) -> dict[str, object]:
    """Return name, type and direction; of an imported service its servers with their first answers, too.

    A topic under exclusive control has its ``holder``.

    A server that left keeps its answers and has ``is_there`` false.
    """
    fields: dict[str, object] = {
        "name": short_id(spec.name),
        "local": spec.local,
        "type": spec.type_name,
        "kind": spec.rule.kind,
        "is_exposed": spec.is_exposed,
    }
    if isinstance(flow, ImportedTopic) and flow.control is not None:
        fields["holder"] = "" if flow.control.holder is None else short_id(flow.control.holder)
    if isinstance(flow, ImportedService):
        there = set(flow.servers)
        every = sorted(there | flow.first_answers.keys())[:_SERVERS_MAX]
        fields["servers"] = [
            {"id": short_id(server), "is_there": server in there, "first": flow.first_answers[server]}
            for server in every
        ]
    return fields
