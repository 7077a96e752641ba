"""Explanation of every rule: its live entities, its delegations, and its faults.

Sans-I/O; from rules, a graph and the held delegations to findings.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from gdp.metadata import SALT, Metadata, hidden
from gdp.names import Name
from gdp.ros_names import Kind
from gdp.trust.right import Right
from proxy.bridge.core.action_interface import action_of
from proxy.bridge.core.node_rules import node_entity
from proxy.check.core.finding import Direction, Finding, Match
from proxy.config.matching import choose, imported
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.core.qos import is_depth_unknown
from proxy.serial.channel import Qos

_NAMES_SHOWN: Final = 10
_OPTIONS: Final = ("author", "maintainer", "description")  # metadata for which ``gdp delegate`` has an option


class Delegated(Protocol):
    """Properties of a delegation that an explanation needs."""

    @property
    def rights(self) -> frozenset[Right]:
        """Return the rights of this node."""

    @property
    def metadata(self) -> Metadata | None:
        """Return the metadata of the name, if its giver stated them."""


@dataclass(frozen=True, slots=True)
class _Side:
    """Roles and rights that one direction and kind needs."""

    role: Role
    right: str
    does: str  # role of a local node
    negative: str


_SIDES: Final[dict[tuple[Direction, bool], _Side]] = {  # the flag: whether it is about a topic
    ("expose", True): _Side(Role.PUBLISHES, "publish", "publishes", "nothing here publishes it now"),
    ("import", True): _Side(Role.SUBSCRIBES, "read", "subscribes to", "nothing here subscribes to it now"),
    ("expose", False): _Side(Role.SERVES, "serve", "serves", "nothing here serves it now"),
    ("import", False): _Side(Role.CALLS, "call", "calls", "nothing here is known to call it now"),
}


def explain(
    expose: Sequence[Rule], imports: Sequence[Rule], graph: Graph | None, held: Mapping[Name, Delegated]
) -> list[Finding]:
    """Return one finding for each rule, in the order of the file.

    Args:
        graph: live entities; None: there is no live endpoint, and missing entities are not reported.
        held: by the name that each is about.
    """
    both: tuple[tuple[Direction, Sequence[Rule]], ...] = (("expose", expose), ("import", imports))
    return [_Look(direction, rules, rule, graph, held).finding() for direction, rules in both for rule in rules]


def unknown_qos(imports: Sequence[Rule]) -> list[str]:
    """Return the imported topics whose QoS no rule states: it is known with the first message for a local reader.

    Advertisements have no QoS, which RIBs could read there; it comes sealed, to subscribers.
    """
    return [rule.name for rule in imports if (rule.kind, rule.offered, rule.wants_latched) == ("topic", None, None)]


class _Look:
    """Examination of one rule among the others of its direction."""

    def __init__(
        self,
        direction: Direction,
        rules: Sequence[Rule],
        rule: Rule,
        graph: Graph | None,
        held: Mapping[Name, Delegated],
    ) -> None:
        self._direction = direction
        self._rules = rules
        self._rule = rule
        self._held = held
        self._is_live = graph is not None
        self._side = _SIDES[direction, rule.kind == "topic"]
        kin = list(_of_kind(graph or (), rule.kind))
        kin = [end for end in kin if end.role is self._side.role]
        meant = [end for end in kin if rule.means(end.name)]
        self._left_out = sorted({end.name for end in kin if rule.leaves_out(end.name) and not end.is_proxy})
        ends = [end for end in meant if rule.denied_by(end.name) is None]
        self._denied = dict(self._find_denied([end.name for end in meant]))
        self._ends = [end for end in ends if not end.is_proxy]
        self._proxied = sorted({end.name for end in ends if end.is_proxy} - {end.name for end in self._ends})

    def finding(self) -> Finding:
        matches = tuple(self._match(*each) for each in sorted(self._candidates()))
        denied = tuple(sorted(self._denied.items()))
        return Finding(self._direction, self._rule.kind, self._rule.name, matches, tuple(self._notes(matches)), denied)

    def _find_denied(self, names: Sequence[str]) -> Iterator[tuple[str, str]]:
        """Yield what the rule is about and ``deny`` keeps local: of the graph, of the rule, of held delegations."""
        rule, allowing = self._rule, self._rule.within(None, ())
        stated = [] if rule.is_pattern else [rule.local]
        held = [
            allowing.local_of(each.metadata) for each in self._held.values() if each.metadata and self._has_right(each)
        ]
        for local in [*stated, *names, *(each for each in held if each is not None)]:
            pattern = rule.denied_by(local)
            if pattern is not None:
                yield local, pattern

    def _candidates(self) -> set[tuple[str, str]]:
        """Return local names and types: from the rule, from delegations, and from the live graph."""
        rule = self._rule
        found = set()
        if not rule.is_pattern and rule.type_name and not rule.is_denied:
            found.add((rule.local, rule.type_name))
        for name, delegation in self._held.items():
            if delegation.metadata is None or not self._has_right(delegation):
                continue
            match imported(self._rules, name, delegation.metadata):
                case (by, local) if by is rule:
                    found.add((local, str(delegation.metadata["type"])))
        for end in self._ends:
            if choose(self._rules, rule.kind, end.name, end.type_name) is rule:
                found.add((end.name, end.type_name or rule.type_name))
        known = {local for local, type_name in found if type_name}
        return {(local, type_name) for local, type_name in found if type_name or local not in known}

    def _match(self, local: str, type_name: str) -> Match:
        named = [end for end in self._ends if end.name == local]
        ends = [end for end in named if end.type_name in ("", type_name)]
        foreign = {end.type_name for end in named} - {"", type_name}
        others = sorted(each for each in foreign if self._concerns(local, each))
        overlay = self._rule.overlay_name_of(local, type_name) if type_name else None
        delegation = self._held.get(overlay) if overlay is not None else None
        faults = [*self._type_faults(others), *self._qos_faults(ends)]
        faults += self._right_faults(local, type_name, delegation)
        return Match(
            local=local,
            type_name=type_name,
            nodes=tuple(sorted({end.node or "a node without a name" for end in ends})),
            qos=tuple(sorted({_qos_in_words(end.qos) for end in ends if end.qos is not None})),
            overlay=overlay,
            is_held=delegation is not None and self._has_right(delegation),
            faults=tuple(faults),
            notes=tuple(self._match_notes(ends, others, type_name)),
        )

    def _concerns(self, local: str, type_name: str) -> bool:
        """Return whether no other rule applies to this type under this name."""
        return choose(self._rules, self._rule.kind, local, type_name) in (None, self._rule)

    def _type_faults(self, others: Sequence[str]) -> Iterator[str]:
        """Yield the faults of the other types under the name."""
        if others and self._rule.type_name:
            yield f"a node here {self._side.does} it as {', '.join(others)}; the rule says {self._rule.type_name}"
        elif others:
            yield f"a node here {self._side.does} it as {', '.join(others)}, too: say in the rule which type is meant"

    def _right_faults(self, local: str, type_name: str, delegation: Delegated | None) -> Iterator[str]:
        if not type_name or (delegation is not None and self._has_right(delegation)):
            return
        if delegation is not None:
            has = ", ".join(sorted(right.value for right in delegation.rights))
            yield f"the delegation gives {has}, not {self._side.right}"
        else:
            yield f"no delegation; {_how_to_delegate(self._rule.metadata_of(local, type_name), self._side.right)}"

    def _qos_faults(self, ends: Sequence[GraphEntity]) -> Iterator[str]:
        """Yield the QoS that local readers request beyond what the rule lets the proxy offer."""
        if self._direction == "expose":
            return
        profiles = [(end.node, end.qos) for end in ends if end.qos is not None]
        for node, qos in profiles:
            if qos.reliability == "reliable" and self._rule.wants_reliable is False:
                yield f"{node} asks for reliable, and the rule says reliable: false"
            if qos.durability == "transient_local" and self._rule.wants_latched is False:
                yield f"{node} asks for transient local, and the rule says latched: false"

    def _match_notes(self, ends: Sequence[GraphEntity], others: Sequence[str], type_name: str) -> Iterator[str]:
        if self._is_live and not ends and not others:
            yield self._side.negative
        if not type_name:
            yield "its type is not known yet"
        offers = [end.qos for end in ends if end.qos is not None]
        if self._direction == "expose" and self._rule.history is None and is_depth_unknown(offers):
            yield "DDS does not tell its depth: the proxy counts what a late reader gets; the rule's 'history' sets it"
        if self._direction == "expose" and self._rule.wants_reliable:
            for end in ends:
                if end.qos is not None and end.qos.reliability == "best_effort":
                    yield f"{end.node} offers best effort: what is lost before the proxy stays lost"

    def _notes(self, matches: Sequence[Match]) -> Iterator[str]:
        if self._denied:
            names = [f"{name} ({pattern})" for name, pattern in sorted(self._denied.items())]
            yield f"denied, hence left alone: {_listed(names)}"
        elif not matches:
            foreign = sorted({end.type_name for end in self._ends if not self._rule.fits_type(end.type_name)})
            if foreign:
                yield f"what matches here is {', '.join(foreign)}, not {self._rule.type_name}"
            elif self._direction == "import":
                yield "no delegation held fits it, and nothing here asks for it"
            elif self._is_live:
                yield "nothing here matches it yet"
        if self._left_out:
            yield f"every node has it, so name it in full if it is to cross: {_listed(self._left_out)}"
        if self._proxied:
            yield f"of another proxy, hence left alone: {', '.join(self._proxied)}"
        silent = sum(each.metadata is None and self._has_right(each) for each in self._held.values())
        if silent and (self._rule.is_pattern or not self._rule.type_name):
            yield (
                f"delegations that do not say what they are for: {silent};"
                " only a rule with a full name and type finds them"
            )

    def _has_right(self, delegation: Delegated) -> bool:
        return self._side.right in {right.value for right in delegation.rights}


def _of_kind(graph: Iterable[GraphEntity], kind: Kind) -> Iterator[GraphEntity]:
    """Yield the entities of topics, of services, or of actions; actions and nodes appear under their own names."""
    for end in graph:
        if kind == "node":
            yield node_entity(end)
            continue
        is_topic = end.role in (Role.PUBLISHES, Role.SUBSCRIBES)
        if kind != "action":
            if is_topic == (kind == "topic"):
                yield end
        elif not is_topic and (action := action_of(end)):
            yield GraphEntity(end.role, *action, end.node, end.key)


def _listed(names: Sequence[str]) -> str:
    return f"{len(names)}: {', '.join(names[:_NAMES_SHOWN])}{', ...' * (len(names) > _NAMES_SHOWN)}"


def _qos_in_words(qos: Qos) -> str:
    return f"{qos.reliability}, {qos.durability}".replace("_", " ")


def _how_to_delegate(metadata: Metadata, right: str) -> str:
    """Return how the owner creates the delegation: a command, as far as its options can state these metadata."""
    words = ["gdp", "delegate", "name", "--owner", "OWNER", "--card", "node.card", "--right", right]
    for key, value in metadata.items():
        if isinstance(value, int) and key != "pin":
            return f"its owner makes one for these metadata: {hidden(metadata)}"
        if key in ("kind", "name", "type", *_OPTIONS) or isinstance(value, int):
            words += [f"--{key}", str(value)]
        else:
            words += ["--salt-file", "FILE"] if key == SALT else ["--meta", f"{key}={value}"]
    words += ["--out", f"{str(metadata['name']).strip('/').replace('/', '_')}.delegation"]
    return f"its owner makes one with: {shlex.join(words)}"
