"""Rows of a bridge for the control command ``topics``: what crosses, with its counts, and what could.

Sans-I/O; it reads counts of flows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

from gdp.client.participant import Participant, Topic
from gdp.message.loss import LossReason
from gdp.state.topic_rows import Direction, TopicRow, held_row
from proxy.bridge.bridge import Flow
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.exposed_service import ExposedService
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.imported_service import ImportedService
from proxy.bridge.imported_topic import ImportedTopic

__all__ = ["flow_rows"]

_HIDDEN = "/_gdp_proxy"  # presence topics of proxies


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
    if isinstance(flow, ExposedService):
        return row(
            direction=Direction.OUT,
            messages=flow.requests,
            bytes=flow.request_bytes,
            publishers=1,
            readers=len(member.services.connected_peers(spec.name)),
        )
    assert isinstance(flow, ImportedService)
    return row(
        direction=Direction.IN,
        messages=flow.requests,
        bytes=flow.request_bytes,
        lost=flow.failed,
        late=flow.late,
        publishers=len(flow.servers),
    )
