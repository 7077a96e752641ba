"""Result of a live run: published and received messages, one row a topic, and one for the service.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from gdp.errors import LocalError
from lab.events import Event
from proxy.recordings.compare import TopicComparison, compare_digests
from ring.nodes.content import LAMP, LAMP_TYPE
from ring.result import Journey, TopicResult, put_together


@dataclass(frozen=True, slots=True)
class Heard:
    """Reports of the nodes, one form for each role; see ``nodes/roles.py``."""

    talkers: tuple[Event, ...]
    lamp: Event
    listener: Event
    caller: Event


def rows(heard: Heard, carried: Sequence[Event]) -> tuple[TopicResult, ...]:
    """Return the rows of the table.

    Args:
        carried: measurements of the server's proxy, one event a topic; latencies are the listener's.
    """
    reports = [_with_latency(each, _of(each.text("topic"), heard.listener.parts("topics"))) for each in carried]
    return (*put_together(_compared(heard), sorted(reports, key=lambda each: each.count("received"))), _lamp(heard))


def _compared(heard: Heard) -> Iterator[TopicComparison]:
    for said in heard.talkers:
        topic = said.text("topic")
        arrived = _of(topic, heard.listener.parts("topics")).texts("heard")
        sent = map(bytes.fromhex, said.texts("sent"))
        yield compare_digests(topic, said.text("type"), said.count("bytes"), sent, map(bytes.fromhex, arrived))


def _lamp(heard: Heard) -> TopicResult:
    """Return the row of the calls: each must be answered, with the reply of a lamp that is switched once a call."""
    calls, answered = heard.caller.count("calls"), heard.caller.count("answered")
    wrong = answered - heard.caller.count("right")
    comparison = TopicComparison(
        topic=LAMP,
        type_name=LAMP_TYPE,
        messages=calls,
        bytes=heard.caller.count("bytes"),
        delivered=answered,
        lost=calls - answered,
        duplicated=max(heard.lamp.count("served") - calls, 0),
        altered=wrong,
        identical=answered == calls and not wrong,
        in_order=True,
    )
    latency = heard.caller.part("latency_ms")
    median_ms, p99_ms, max_ms = (latency.number_or_none(key) for key in ("median", "p99", "max"))
    way = Journey(median_ms=median_ms, p99_ms=p99_ms, max_ms=max_ms, silent_ms=heard.caller.number_or_none("silent_ms"))
    return TopicResult(comparison, way, is_service=True)


def _of(topic: str, events: Sequence[Event]) -> Event:
    for event in events:
        if event.text("topic") == topic:
            return event
    raise LocalError(f"no report on {topic}")


def _with_latency(carried: Event, listener: Event) -> Event:
    measured = {key: listener.fields.get(key) for key in ("latency_ms", "silent_ms")}
    return Event({**carried.fields, **measured})
