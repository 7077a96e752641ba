"""Result of a run, topic by topic, and whether it passed. Sans-I/O."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field, fields
from functools import partial

from gdp.errors import LocalError
from lab.process import Event
from proxy.recordings.compare import TopicComparison, compare_digests
from ring.nodes.content import LAMP, LAMP_TYPE


@dataclass(frozen=True, slots=True, kw_only=True)
class Journey:
    """Measurements of the receiver on one topic.

    Args:
        latency_ms: median, p99 and max; None: not measured.
        parts: fragments of the largest message.
        hops: switches that most messages passed.
        hops_seen: every number of switches that some message passed.
        silent_ms: the longest time between two messages, or between two answers; None: not measured.
    """

    duplicated: int = 0
    latency_ms: Mapping[str, float | None] = field(default_factory=partial(dict.fromkeys, ("median", "p99", "max")))
    silent_ms: float | None = None
    parts: int = 0
    hops: int = 0
    hops_seen: Sequence[int] = ()

    @classmethod
    def from_event(cls, topic: Event) -> Journey:
        """Read one entry of a receiver's report, or what a caller reports."""
        return cls(**{each.name: topic[each.name] for each in fields(cls) if topic.get(each.name) is not None})


@dataclass(frozen=True, slots=True)
class TopicResult:
    """One row of the table. Of a service the messages are calls, and lost ones have no answer."""

    comparison: TopicComparison
    journey: Journey
    is_service: bool = False

    @property
    def duplicated(self) -> int:
        """Return the number of duplicates: the larger of the recording's and the receiver's."""
        return max(self.comparison.duplicated, self.journey.duplicated)

    @property
    def faults(self) -> list[str]:
        """Return the faults of this topic, as text."""
        of = self.comparison
        found = []
        if of.lost:
            found.append(f"{of.lost} {'calls without an answer' if self.is_service else 'lost'}")
        if self.duplicated:
            found.append(f"{self.duplicated} {'served twice' if self.is_service else 'duplicated'}")
        if of.altered:
            found.append(f"{of.altered} {'wrong answers' if self.is_service else 'with other bytes than were sent'}")
        if not of.in_order:
            found.append("out of order")
        return found

    def to_json(self) -> dict[str, object]:
        """Return the row for ``--json``."""
        compared = asdict(self.comparison)
        del compared["altered"]
        what = {"kind": "service" if self.is_service else "topic", "type": compared.pop("type_name")}
        return {**compared, **what, **asdict(self.journey), "duplicated": self.duplicated}


@dataclass(frozen=True, slots=True)
class Result:
    """A whole run.

    Args:
        unread: why the end of the recording could not be read; None if all of it was.
        complaints: other faults, such as a side that did not finish.
        silent_s: the longest time in which something was due and nothing came, to half a second.
    """

    topics: tuple[TopicResult, ...]
    settings: Mapping[str, object]
    _: KW_ONLY
    unread: str | None = None
    complaints: tuple[str, ...] = ()
    traffic_s: float = 0.0
    silent_s: float = 0.0

    @property
    def faults(self) -> list[str]:
        """Return all reasons why the run did not pass."""
        per_topic = [f"{row.comparison.topic}: {', '.join(row.faults)}" for row in self.topics if row.faults]
        nothing = [] if any(row.comparison.messages for row in self.topics) else ["no message was sent"]
        return [*self.complaints, *nothing, *per_topic]

    @property
    def passed(self) -> bool:
        """Return whether every message arrived identical and in order."""
        return not self.faults

    def to_json(self) -> dict[str, object]:
        """Return the result for ``--json``."""
        return {
            "passed": self.passed,
            "topics": [row.to_json() for row in self.topics],
            "settings": dict(self.settings),
            "unread": self.unread,
            "traffic_s": round(self.traffic_s, 3),
            "silent_s": round(self.silent_s, 3),
            "faults": self.faults,
        }


def put_together(comparisons: Iterable[TopicComparison], reports: Sequence[Event]) -> tuple[TopicResult, ...]:
    """Return one row per compared topic, with the receiver's measurements where there are any."""
    journeys = {(report["topic"], report["type"]): Journey.from_event(report) for report in reports}
    return tuple(
        TopicResult(comparison, journeys.get((comparison.topic, comparison.type_name), Journey()))
        for comparison in comparisons
    )


@dataclass(frozen=True, slots=True)
class Heard:
    """Reports of the nodes, one form for each role; see ``nodes/roles.py``."""

    talkers: tuple[Event, ...]
    lamp: Event
    listener: Event
    caller: Event


def rows(heard: Heard, carried: Sequence[Event]) -> tuple[TopicResult, ...]:
    """Return the rows of the table.

    ``carried``: measurements of the server's proxy, one event a topic; latencies are the listener's.
    """
    reports = [_with_latency(each, _of(each["topic"], heard.listener["topics"])) for each in carried]
    return (*put_together(_compared(heard), sorted(reports, key=lambda each: each["received"])), _lamp(heard))


def _compared(heard: Heard) -> Iterator[TopicComparison]:
    for said in heard.talkers:
        topic = said["topic"]
        arrived = _of(topic, heard.listener["topics"])["heard"]
        sent = map(bytes.fromhex, said["sent"])
        yield compare_digests(topic, said["type"], said["bytes"], sent, map(bytes.fromhex, arrived))


def _lamp(heard: Heard) -> TopicResult:
    """Return the row of the calls: each must be answered, with the reply of a lamp that is switched once a call."""
    calls, answered = heard.caller["calls"], heard.caller["answered"]
    wrong = answered - heard.caller["right"]
    comparison = TopicComparison(
        topic=LAMP,
        type_name=LAMP_TYPE,
        messages=calls,
        bytes=heard.caller["bytes"],
        delivered=answered,
        lost=calls - answered,
        duplicated=max(heard.lamp["served"] - calls, 0),
        altered=wrong,
        identical=answered == calls and not wrong,
        in_order=True,
    )
    return TopicResult(comparison, Journey.from_event(heard.caller), is_service=True)


def _of(topic: str, events: Sequence[Event]) -> Event:
    for event in events:
        if event["topic"] == topic:
            return event
    raise LocalError(f"no report on {topic}")


def _with_latency(carried: Event, listener: Event) -> Event:
    return {**carried, **{key: listener.get(key) for key in ("latency_ms", "silent_ms")}}
