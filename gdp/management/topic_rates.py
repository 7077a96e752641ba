"""Rates of the names that running nodes carry, from two answers of each node."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from gdp.management.running_nodes import NodeTopics, RunningNode
from gdp.names import Name
from gdp.state.topic_rows import Direction, TopicRow


@dataclass(frozen=True, slots=True, kw_only=True)
class RatedRow:
    """A row of a node with its rates; None: not known, as of a name that has just appeared.

    Attributes:
        topic: ROS name; for a switch that of a proxy of this machine, or the short form of the name.
        messages_s: of a switch: frames.
        lost: since the answer before.
    """

    node: RunningNode
    row: TopicRow
    topic: str
    type: str
    messages_s: float | None = None
    bits_s: float | None = None
    lost: int | None = None
    late: int | None = None

    @property
    def size_bytes(self) -> float | None:
        """Return the mean size of a message, in bytes; None: there was none."""
        if not self.row.messages or self.row.bytes is None:
            return None
        return self.row.bytes / self.row.messages

    def to_fields(self) -> dict[str, object]:
        """Return the row as JSON fields."""
        return {
            "topic": self.topic,
            "name": self.row.name,
            "kind": self.row.kind,
            "type": self.type,
            "direction": self.row.direction.value,
            "messages_s": _rounded(self.messages_s),
            "bits_s": _rounded(self.bits_s),
            "size_bytes": _rounded(self.size_bytes),
            "messages": self.row.messages,
            "lost": self.row.lost,
            "late": self.row.late,
            "lost_since": self.lost,
            "late_since": self.late,
            "publishers": self.row.publishers,
            "readers": self.row.readers,
            "rights": self.row.rights,
            "node": self.node.name.to_text(),
            "role": self.node.role,
        }


def known_names(answers: Iterable[NodeTopics]) -> dict[str, TopicRow]:
    """Return what the proxies of this machine know of each 256-bit name, by its hex digits."""
    rows = (row for answer in answers for row in answer.rows if row.topic)
    return {row.name: row for row in rows}


def rated_rows(before: Iterable[NodeTopics], now: Iterable[NodeTopics]) -> Iterator[RatedRow]:
    """Yield each row of the later answers, with its rates since the earlier ones."""
    answers = list(now)
    meanings = known_names(answers)
    earlier = {
        (answer.node.name, row.name, row.direction): (answer.mono_s, row) for answer in before for row in answer.rows
    }
    for answer in answers:
        for row in answer.rows:
            meaning = meanings.get(row.name)
            topic = row.topic or (meaning.topic if meaning is not None else Name.from_text(row.name).short)
            type_name = row.type or (meaning.type if meaning is not None else "")
            old = earlier.get((answer.node.name, row.name, row.direction))
            passed_s = 0.0 if old is None else answer.mono_s - old[0]
            rated = RatedRow(node=answer.node, row=row, topic=topic, type=type_name)
            has_rates = old is not None and passed_s > 0 and row.direction is not Direction.HELD
            yield _with_rates(rated, old[1], passed_s) if old is not None and has_rates else rated


def _with_rates(rated: RatedRow, old: TopicRow, passed_s: float) -> RatedRow:
    """Return a row with the rates since an earlier one; a count that fell belongs to a new flow, and has no rate."""
    messages, size = _rise(old.messages, rated.row.messages), _rise(old.bytes, rated.row.bytes)
    return replace(
        rated,
        messages_s=None if messages is None else messages / passed_s,
        bits_s=None if size is None else 8 * size / passed_s,
        lost=_rise(old.lost, rated.row.lost),
        late=_rise(old.late, rated.row.late),
    )


def _rise(old: int | None, new: int | None) -> int | None:
    return None if old is None or new is None or new < old else new - old


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
