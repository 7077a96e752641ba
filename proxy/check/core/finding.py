"""Finding about a rule of ``proxy.yaml``.

Sans-I/O. ``explain`` creates findings, ``table`` formats them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from gdp.names import Name
from gdp.ros_names import Kind

Direction: TypeAlias = Literal["expose", "import"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """One name under a rule.

    Args:
        type_name: empty while unknown.
        nodes: local nodes of the opposite role; empty: there are none.
        qos: what they offer or request, such as ``reliable, transient local``; empty where QoS does not apply.
        overlay: the overlay name; None while the type is unknown.
        is_held: whether this node has the delegation that the rule needs.
        faults: reasons why it cannot cross.
        notes: remarks that need no action.
    """

    local: str
    type_name: str
    nodes: tuple[str, ...]
    qos: tuple[str, ...]
    overlay: Name | None
    is_held: bool
    faults: tuple[str, ...]
    notes: tuple[str, ...]

    def to_fields(self) -> dict[str, object]:
        """Return the JSON form."""
        return {
            "local": self.local,
            "type": self.type_name or None,
            "nodes": list(self.nodes),
            "qos": list(self.qos),
            "overlay": self.overlay.to_text() if self.overlay is not None else None,
            "held": self.is_held,
            "faults": list(self.faults),
            "notes": list(self.notes),
        }


@dataclass(frozen=True, slots=True)
class Finding:
    """One rule: its matches, and the faults that concern no single name of it.

    Args:
        denied: local names that the rule is about and that never cross, each with its pattern under ``deny``.
    """

    direction: Direction
    kind: Kind
    name: str
    matches: tuple[Match, ...]
    notes: tuple[str, ...]
    denied: tuple[tuple[str, str], ...] = ()

    def to_fields(self) -> dict[str, object]:
        """Return the JSON form."""
        return {
            "direction": self.direction,
            "kind": self.kind,
            "rule": self.name,
            "matches": [match.to_fields() for match in self.matches],
            "denied": [{"local": local, "pattern": pattern} for local, pattern in self.denied],
            "notes": list(self.notes),
        }
