"""Rows of the control command ``topics``: the names that a node carries, and its counts of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from gdp.diagnosis.fields import from_fields
from gdp.errors import DropReason, RemoteError

if TYPE_CHECKING:  # a client reads rows, and needs no core
    from gdp.client.participant import Topic

ROWS_MAX: Final = 400  # in one response; each has less than 600 of its 256 Ki bytes


class Direction(Enum):
    """Direction of a name's traffic, as seen by the node."""

    OUT = "out"  # from this machine to the overlay
    IN = "in"
    THROUGH = "through"  # forwarded by a switch
    HELD = "held"  # the node may use it, and does not at present


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicRow:
    """One name at one node. A count is None where the node does not count it; counts only rise while the node runs.

    Attributes:
        name: 64 hex digits.
        topic: ROS name here; empty where the node does not know it, as a switch does not.
        kind: topic, service or action; empty where unknown.
        messages: of a service: calls; of a switch: frames.
        bytes: in ROS's wire form; of a switch: of frames.
        lost: messages that did not arrive; of a service: calls without a response.
        late: messages that could not leave in time, or responses that were not the first.
        publishers: known ones, or servers of a service.
        readers: known ones, or clients of a service.
        rights: of a held name, such as ``read``.
    """

    name: str
    direction: Direction
    topic: str = ""
    kind: str = ""
    type: str = ""
    messages: int | None = None
    bytes: int | None = None
    lost: int | None = None
    late: int | None = None
    publishers: int | None = None
    readers: int | None = None
    rights: str = ""

    def to_fields(self) -> dict[str, object]:
        """Return the row as JSON fields."""
        return {**asdict(self), "direction": self.direction.value}


def held_row(topic: Topic) -> TopicRow:
    """Return the row of a delegation whose name is not in use."""
    metadata = dict(topic.delegation.metadata or {})
    return TopicRow(
        name=topic.name.to_text(),
        direction=Direction.HELD,
        topic=str(metadata.get("name", "")),
        kind=str(metadata.get("kind", "")),
        type=str(metadata.get("type", "")),
        rights=", ".join(sorted(right.value for right in topic.delegation.rights)),
    )


def rows_to_fields(rows: Iterable[TopicRow], mono_s: float) -> dict[str, object]:
    """Return the response's fields; above ``ROWS_MAX`` the rows with the fewest messages are left out, and counted.

    Args:
        mono_s: monotonic second of the counts; all processes of a host share that clock.
    """
    ordered = sorted(rows, key=lambda row: row.messages or 0, reverse=True)
    kept = [row.to_fields() for row in ordered[:ROWS_MAX]]
    return {"mono_s": mono_s, "topics": kept, "left_out": len(ordered) - len(kept)}


def rows_from_fields(fields: Mapping[str, object]) -> tuple[float, list[TopicRow], int]:
    """Return second, rows and the number of rows left out. Raises ``RemoteError``: the response has another form."""
    mono_s, rows, left_out = fields.get("mono_s"), fields.get("topics"), fields.get("left_out")
    if not isinstance(mono_s, int | float) or not isinstance(rows, list) or not isinstance(left_out, int):
        raise RemoteError(DropReason.MALFORMED, "a response about topics")
    return float(mono_s), [from_fields(TopicRow, row if isinstance(row, dict) else {}) for row in rows], left_out
