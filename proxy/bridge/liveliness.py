"""Liveliness of the names that a proxy carries: which parties there are, and what changes among them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source of the idea: DDS 1.4, section 2.2.3.11 (LIVELINESS) and
2.2.3.7 (DEADLINE).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from gdp.errors import LocalError

PartyRole: TypeAlias = Literal["publisher", "reader", "server", "client"]
Change: TypeAlias = Literal["appears", "goes", "silent", "heard"]
PARTIES_MAX: Final = 32  # of one name in a status
_ROLES: Final[tuple[PartyRole, ...]] = ("publisher", "reader", "server", "client")


@dataclass(frozen=True, slots=True)
class Party:
    """Another node that publishes, reads, serves or calls a name.

    Args:
        node: its name, 64 hex digits.
        heard_ago_s: seconds since its last message; None: none came yet, or its role sends none.
        is_silent: it has stopped reporting, and may return.
        has_control: whether it holds the control of a topic under exclusive control; None: another name.
    """

    role: PartyRole
    node: str
    heard_ago_s: float | None = None
    is_silent: bool = False
    has_control: bool | None = None

    @property
    def control(self) -> dict[str, object]:
        """Return the JSON field of control, for a topic under exclusive control."""
        return {} if self.has_control is None else {"control": self.has_control}


@dataclass(frozen=True, slots=True)
class NameLiveliness:
    """Parties of one name.

    Args:
        shared: the ROS name that all sides know.
        is_joined: whether this machine takes part now; an imported topic without a local reader is not subscribed.
    """

    kind: str
    local: str
    shared: str
    is_exposed: bool
    is_joined: bool
    parties: Sequence[Party]

    def to_fields(self) -> dict[str, object]:
        """Return the JSON form that ``names_from_fields`` reads; parties above ``PARTIES_MAX`` are counted only."""
        parties = [
            {
                "role": each.role,
                "node": each.node,
                "heard_ago_s": None if each.heard_ago_s is None else round(each.heard_ago_s, 3),
                "silent": each.is_silent,
                **each.control,
            }
            for each in self.parties[:PARTIES_MAX]
        ]
        return {
            "kind": self.kind,
            "local": self.local,
            "shared": self.shared,
            "side": "expose" if self.is_exposed else "import",
            "joined": self.is_joined,
            "count": len(self.parties),
            "parties": parties,
        }


@dataclass(frozen=True, slots=True)
class LivelinessEvent:
    """One change: a party appears or goes, is silent beyond its deadline, or is heard again."""

    change: Change
    role: PartyRole
    kind: str
    name: str
    node: str

    def to_fields(self) -> dict[str, object]:
        """Return the JSON form."""
        return {"event": self.change, "role": self.role, "kind": self.kind, "name": self.name, "node": self.node}


class LivelinessTracker:
    """Changes between observations.

    Args:
        deadline_s: a publisher that sends nothing for longer is silent; None: only who stopped reporting is.
    """

    def __init__(self, deadline_s: float | None = None) -> None:
        self._deadline_s = deadline_s
        self._known: dict[tuple[str, str, PartyRole, str], bool] = {}  # kind, name, role, node -> silent
        self._since_s: dict[tuple[str, str, PartyRole, str], float] = {}  # when a publisher was seen first

    def update(self, names: Iterable[NameLiveliness], now_s: float) -> list[LivelinessEvent]:
        """Take an observation; return what changed since the last one, in the order of names and nodes."""
        present = {(each.kind, each.shared, party.role, party.node): party for each in names for party in each.parties}
        events: list[LivelinessEvent] = []
        for key in sorted(self._known.keys() - present.keys()):
            del self._known[key]
            self._since_s.pop(key, None)
            events.append(_event("goes", *key))
        for key in sorted(present):
            since_s = self._since_s.setdefault(key, now_s)
            is_silent = self._is_silent(present[key], now_s - since_s)
            before = self._known.get(key)
            self._known[key] = is_silent
            if before is None:
                events.append(_event("appears", *key))
            if is_silent and not before:
                events.append(_event("silent", *key))
            elif before and not is_silent:
                events.append(_event("heard", *key))
        return events

    def is_silent(self, name: NameLiveliness, party: Party) -> bool:
        """Return whether a party was silent at the last observation."""
        return self._known.get((name.kind, name.shared, party.role, party.node), party.is_silent)

    def _is_silent(self, party: Party, known_for_s: float) -> bool:
        if party.is_silent:
            return True
        if self._deadline_s is None or party.role != "publisher":
            return False
        ago_s = known_for_s if party.heard_ago_s is None else party.heard_ago_s
        return ago_s > self._deadline_s


def names_from_fields(listed: object) -> Iterator[NameLiveliness]:
    """Yield the names that a status lists. Raises ``LocalError``: another form."""
    if not isinstance(listed, list):
        raise LocalError("the proxy reports no liveliness; restart it with this version")
    for fields in listed:
        match fields:
            case {
                "kind": str(kind), "local": str(local), "shared": str(shared), "side": str(side),
                "joined": bool(joined), "parties": list(parties),
            }:  # fmt: skip
                yield NameLiveliness(kind, local, shared, side == "expose", joined, [_party(each) for each in parties])
            case _:
                raise LocalError("the proxy reports liveliness in another form; restart it with this version")


def _party(fields: Mapping[str, object]) -> Party:
    role = next((each for each in _ROLES if each == fields.get("role")), None)
    ago_s = fields.get("heard_ago_s")
    if role is None or (ago_s is not None and not isinstance(ago_s, int | float)):
        raise LocalError("the proxy reports liveliness in another form; restart it with this version")
    control = fields.get("control")
    has_control = control if isinstance(control, bool) else None
    return Party(role, str(fields.get("node")), ago_s, fields.get("silent") is True, has_control)


def _event(change: Change, kind: str, name: str, role: PartyRole, node: str) -> LivelinessEvent:
    return LivelinessEvent(change, role, kind, name, node)
