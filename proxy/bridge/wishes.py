"""Which local things are to cross, by the rules and by what is live.

Place: pure. What no rule names stays local. Concrete rules come before patterns; the first that matches holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from gdp.metadata import Metadata
from gdp.names import Name
from proxy.bridge.parts import action_of, is_part
from proxy.endpoints.endpoint import End, Graph, Role
from proxy.faults import Fault
from proxy.rules import choice
from proxy.rules.choice import choose
from proxy.rules.rule import Kind, Rule

__all__ = ["Complaint", "Wish", "exposed", "imported"]

_SHOWS: Final[dict[Kind, Role]] = {"topic": Role.PUBLISHES, "service": Role.SERVES, "action": Role.SERVES}
_WANTS: Final[dict[Kind, Role]] = {"topic": Role.SUBSCRIBES, "service": Role.CALLS, "action": Role.CALLS}

_PLAIN: Final[tuple[Kind, ...]] = ("topic", "service")


class Wish(NamedTuple):
    """One local name that is to cross, as which overlay name, by which rule."""

    is_exposed: bool
    local: str
    type_name: str
    name: Name
    rule: Rule


class Complaint(NamedTuple):
    """Why something that a rule names cannot cross as it is."""

    local: str
    fault: Fault
    detail: str


def exposed(rules: Sequence[Rule], graph: Graph, complaints: list[Complaint]) -> Iterator[Wish]:
    """Yield what local nodes publish or serve, and a rule makes global; what is odd goes to ``complaints``."""
    for (kind, local), types in _shown(graph, _SHOWS).items():
        first = choose(rules, kind, local)
        if first is None:
            continue
        wanted: dict[int, tuple[str, Rule]] = {}  # of each rule the first type: topics of a recording may have several
        for type_name in sorted(types):
            rule = choose(rules, kind, local, type_name)
            if rule is not None:
                wanted.setdefault(id(rule), (type_name, rule))
        if len(wanted) < len(types):
            said = f"; the rule says {first.type_name}" if first.type_name else ""
            complaints.append(Complaint(local, Fault.OTHER_TYPE, f"local nodes use {', '.join(sorted(types))}{said}"))
        for type_name, rule in wanted.values():
            yield Wish(True, local, type_name, rule.overlay_name_of(local, type_name), rule)


def imported(
    rules: Sequence[Rule], graph: Graph, held: Iterable[tuple[Metadata, Name]], complaints: list[Complaint]
) -> Iterator[Wish]:
    """Yield what is to be had from elsewhere: by concrete rules, by delegations held, by what local nodes ask for."""
    seen: set[Name] = set()
    wanted = _shown(graph, _WANTS)
    had: dict[tuple[Kind, str], set[str]] = {}
    for wish in _imported(rules, wanted, held):
        had.setdefault((wish.rule.kind, wish.local), set()).add(wish.type_name)
        if wish.name not in seen:
            seen.add(wish.name)
            yield wish
    for (kind, local), types in wanted.items():
        if has := had.get((kind, local)):
            for other in sorted(types - has):
                detail = f"local nodes ask for {other}; what comes is {', '.join(sorted(has))}"
                complaints.append(Complaint(local, Fault.OTHER_TYPE, detail))


def _imported(
    rules: Sequence[Rule], wanted: Mapping[tuple[Kind, str], set[str]], held: Iterable[tuple[Metadata, Name]]
) -> Iterator[Wish]:
    for rule in rules:
        if not rule.is_pattern and rule.type_name:
            yield Wish(False, rule.local, rule.type_name, rule.overlay_name, rule)
    for metadata, name in held:
        found = choice.imported(rules, name, metadata)
        if found is not None:
            yield Wish(False, found[1], str(metadata["type"]), name, found[0])
    for (kind, local), types in wanted.items():
        for type_name in sorted(types):
            asked = choose(rules, kind, local, type_name)
            if asked is not None:
                yield Wish(False, local, type_name, asked.overlay_name_of(local, type_name), asked)


def _shown(graph: Graph, roles: Mapping[Kind, Role]) -> dict[tuple[Kind, str], set[str]]:
    """Return the types of what nodes other than proxies show, by kind and local name."""
    shown: dict[tuple[Kind, str], set[str]] = {}
    for end in sorted((end for end in graph if not end.is_proxy and end.type_name), key=lambda end: end.name):
        for kind, name, type_name in _things(end, roles):
            shown.setdefault((kind, name), set()).add(type_name)
    return shown


def _things(end: End, roles: Mapping[Kind, Role]) -> Iterator[tuple[Kind, str, str]]:
    action = action_of(end)
    if action is not None and end.role is roles["action"]:
        yield "action", *action
    elif not is_part(end.name):
        for kind in _PLAIN:
            if end.role is roles[kind]:
                yield kind, end.name, end.type_name
