"""Readings of one poll: the snapshots of nodes in the form in which a scene is made of them.

Sans-I/O. The nodes are of the same user, yet may be of another version, so every field is checked: one of the wrong
form counts as absent.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeGuard

Fields = Mapping[str, object]
SUPERVISOR: Final = "supervisor"


def _is_map(value: object) -> TypeGuard[Fields]:
    return isinstance(value, Mapping)


def text_of(fields: Fields, key: str) -> str:
    """Return a text, or an empty one."""
    value = fields.get(key)
    return value if isinstance(value, str) else ""


def number_of(fields: Fields, key: str) -> float:
    """Return a number, or 0."""
    value = fields.get(key)
    return float(value) if isinstance(value, int | float) else 0.0


def flag_of(fields: Fields, key: str) -> bool:
    """Return whether a field is true."""
    return fields.get(key) is True


def map_of(fields: Fields, key: str) -> Fields:
    """Return a mapping, or an empty one."""
    value = fields.get(key)
    return value if _is_map(value) else {}


def items_of(fields: Fields, key: str) -> Iterator[Fields]:
    """Yield the mappings of a list."""
    value = fields.get(key)
    if isinstance(value, list):
        yield from (each for each in value if _is_map(each))


def rows_of(fields: Fields, key: str, width: int) -> Iterator[Sequence[object]]:
    """Yield the lists of a list that have so many items."""
    value = fields.get(key)
    if isinstance(value, list):
        yield from (each for each in value if isinstance(each, list) and len(each) == width)


@dataclass(frozen=True, slots=True)
class Reading:
    """What one control socket answered.

    Args:
        fields: its snapshot.
        topology: link states that a switch knows; empty where it was not asked.
    """

    fields: Fields
    topology: Fields = field(default_factory=dict)

    @property
    def role(self) -> str:
        """Return the role of the node, or ``supervisor``."""
        return text_of(self.fields, "role")

    @property
    def id(self) -> str:
        """Return the node's id."""
        return text_of(self.fields, "id")

    @property
    def is_node(self) -> bool:
        """Return whether it is a node of the overlay."""
        return bool(self.id) and self.role != SUPERVISOR
