"""Desired flows: the local names that are to cross, from the rules and the live graph.

Sans-I/O. A name that no rule matches stays local. Concrete rules come before patterns; the first match applies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.metadata import Metadata
from gdp.names import Name
from gdp.ros_names import NODE_TYPE, Kind, is_pattern
from gdp.trust.right import Right, right_on
from proxy.bridge.core.action_interface import action_of
from proxy.bridge.core.node_rules import nodes_in
from proxy.bridge.faults import Fault
from proxy.config import matching
from proxy.config.matching import choose
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role

_CALLED: Final[tuple[Kind, ...]] = ("service", "action", "node")
ROLES: Final[dict[bool, dict[Kind, Role]]] = {  # of a local node, by whether the name is exposed, and by kind
    True: {"topic": Role.PUBLISHES, **dict.fromkeys(_CALLED, Role.SERVES)},
    False: {"topic": Role.SUBSCRIBES, **dict.fromkeys(_CALLED, Role.CALLS)},
}

_PLAIN: Final[tuple[Kind, ...]] = ("topic", "service")
_KEPT, _KEPT_MIN = 4, 1_024  # names in a ``RuleMemo``: of each that the graph shows, and above


class FlowSpec(NamedTuple):
    """One local name that is to cross, with its overlay name and its rule."""

    is_exposed: bool
    local: str
    type_name: str
    name: Name
    rule: Rule

    @property
    def right(self) -> Right:
        """Return the right on the overlay name that it takes."""
        return right_on(self.rule.kind, gives=self.is_exposed)

    def has_short_queues(self, ros: int) -> bool:
        """Return whether its local nodes drop requests or responses that come faster than they take them.

        The services of ROS 2 do. The parts of an action have queues of their own, and few calls under way; results take
        as long as they want.
        """
        return ros == 2 and self.rule.kind == "service"


class ConfigProblem(NamedTuple):
    """Reason why something that a rule names cannot cross at present."""

    local: str
    fault: Fault
    detail: str


class DeniedName(NamedTuple):
    """Local name that a rule is about, and the pattern under ``deny`` because of which it stays local."""

    is_exposed: bool
    local: str
    pattern: str


_Exposed = tuple[tuple[FlowSpec, ...], ConfigProblem | None]


@dataclass(slots=True)
class RuleMemo:
    """What the rules of one endpoint mean for each name, found once: a refresh of a large graph asks for all of them.

    Attributes:
        exposed: by kind, local name and the types that it shows.
        wanted: by kind, local name and type.
        held: by overlay name.
    """

    exposed: dict[tuple[Kind, str, frozenset[str]], _Exposed] = field(default_factory=dict)
    wanted: dict[tuple[Kind, str, str], FlowSpec | None] = field(default_factory=dict)
    held: dict[Name, FlowSpec | None] = field(default_factory=dict)

    def trim(self, names: int) -> None:
        """Forget all if it has far more than a graph shows, of which names have gone."""
        for each in self.exposed, self.wanted:
            if len(each) > _KEPT * names + _KEPT_MIN:
                each.clear()


def denied(rules: Sequence[Rule], graph: Graph, *, is_exposed: bool) -> Iterator[DeniedName]:
    """Yield the denied names of one direction: those of the graph, and those that a rule states."""
    shown = {(rule.kind, rule.local) for rule in rules if rule.is_denied}
    shown |= _shown(graph, ROLES[is_exposed]).keys()
    for kind, local in sorted(shown):
        meant = (rule.denied_by(local) for rule in rules if rule.kind == kind and rule.means(local))
        pattern = next((each for each in meant if each is not None), None)
        if pattern is not None:
            yield DeniedName(is_exposed, local, pattern)


def exposed(
    rules: Sequence[Rule],
    graph: Graph,
    complaints: list[ConfigProblem],
    brought: Sequence[Rule] = (),
    memo: RuleMemo | None = None,
) -> Iterator[FlowSpec]:
    """Yield a flow for each local publisher or server that a rule exposes, and for the nodes of each rule.

    Args:
        complaints: problems are added to them.
        brought: the rules of what nodes have; they apply where no other one does.
        memo: of these rules; None: a new one.
    """
    memo = RuleMemo() if memo is None else memo
    by_node = _by_name(brought)
    of_nodes = {id(each): each for each, _ in nodes_in(rules, graph).values()}
    for each in of_nodes.values():  # one for all nodes of a pattern
        yield FlowSpec(True, each.local, NODE_TYPE, each.overlay_name_of(each.local, NODE_TYPE), each)
    shown = _shown(graph, ROLES[True])
    memo.trim(len(shown))
    for (kind, local), types in shown.items():
        key, of_node = (kind, local, frozenset(types)), by_node.get((kind, local))
        found = memo.exposed.get(key) if of_node is None else _exposed(rules, of_node, *key)
        if found is None:
            found = memo.exposed[key] = _exposed(rules, (), *key)
        flow_specs, problem = found
        if problem is not None:
            complaints.append(problem)
        yield from flow_specs


def _exposed(rules: Sequence[Rule], brought: Sequence[Rule], kind: Kind, local: str, types: frozenset[str]) -> _Exposed:
    """Return the flows of one local name, and its problem."""
    fitting = rules if choose(rules, kind, local) is not None else brought
    first = choose(fitting, kind, local)
    if first is None:
        return (), None
    wanted: dict[int, tuple[str, Rule]] = {}  # first type of each rule: topics of a recording may have several
    for type_name in sorted(types):
        rule = choose(fitting, kind, local, type_name)
        if rule is not None:
            wanted.setdefault(id(rule), (type_name, rule))
    problem = None
    if len(wanted) < len(types):
        said = f"; the rule says {first.type_name}" if first.type_name else ""
        problem = ConfigProblem(local, Fault.OTHER_TYPE, f"local nodes use {', '.join(sorted(types))}{said}")
    found = wanted.values()
    return tuple(FlowSpec(True, local, of, rule.overlay_name_of(local, of), rule) for of, rule in found), problem


def imported(
    rules: Sequence[Rule],
    graph: Graph,
    held: Iterable[tuple[Metadata, Name]],
    complaints: list[ConfigProblem],
    brought: Sequence[Rule] = (),
    memo: RuleMemo | None = None,
) -> Iterator[FlowSpec]:
    """Yield a flow for each name to import: by concrete rules, by held delegations, by requests of local nodes.

    Args:
        brought: the rules of what nodes have; they apply where no other one does.
        memo: of these rules and delegations; None: a new one.
    """
    seen: set[Name] = set()
    wanted = _shown(graph, ROLES[False])
    had: dict[tuple[Kind, str], set[str]] = {}
    memo = RuleMemo() if memo is None else memo
    memo.trim(len(wanted))
    for flow_spec in (*_imported(rules, wanted, held, memo), *_named(brought)):
        had.setdefault((flow_spec.rule.kind, flow_spec.local), set()).add(flow_spec.type_name)
        if flow_spec.name not in seen:
            seen.add(flow_spec.name)
            yield flow_spec
    for (kind, local), types in wanted.items():
        if has := had.get((kind, local)):
            for other in sorted(types - has):
                detail = f"local nodes ask for {other}; what comes is {', '.join(sorted(has))}"
                complaints.append(ConfigProblem(local, Fault.OTHER_TYPE, detail))


def _imported(
    rules: Sequence[Rule],
    wanted: Mapping[tuple[Kind, str], set[str]],
    held: Iterable[tuple[Metadata, Name]],
    memo: RuleMemo,
) -> Iterator[FlowSpec]:
    held = list(held)
    names = {name for _, name in held}
    of_patterns = [each for each, _ in held if each["kind"] == "node" and is_pattern(str(each["name"]))]
    for flow_spec in _named(rules):
        is_in_pattern = any(flow_spec.rule.local_of(each) is not None for each in of_patterns)
        if flow_spec.name in names or not is_in_pattern:
            yield flow_spec
    for metadata, name in held:
        if name not in memo.held:
            found = matching.imported(rules, name, metadata)
            of_rule = None if found is None else FlowSpec(False, found[1], str(metadata["type"]), name, found[0])
            memo.held[name] = of_rule
        if (has := memo.held[name]) is not None:
            yield has
    for (kind, local), types in wanted.items():
        for type_name in sorted(types):
            key = kind, local, type_name
            if key not in memo.wanted:
                memo.wanted[key] = _wanted(rules, *key)
            if (wants := memo.wanted[key]) is not None:
                yield wants


def _wanted(rules: Sequence[Rule], kind: Kind, local: str, type_name: str) -> FlowSpec | None:
    """Return the flow of what local nodes ask for; None: no rule imports it."""
    rule = choose(rules, kind, local, type_name)
    return None if rule is None else FlowSpec(False, local, type_name, rule.overlay_name_of(local, type_name), rule)


def _named(rules: Iterable[Rule]) -> Iterator[FlowSpec]:
    for rule in rules:
        type_name = NODE_TYPE if rule.kind == "node" else rule.type_name
        if not rule.is_pattern and type_name and not rule.is_denied:
            yield FlowSpec(False, rule.local, type_name, rule.overlay_name_of(rule.local, type_name), rule)


def _by_name(rules: Iterable[Rule]) -> Mapping[tuple[Kind, str], list[Rule]]:
    found: dict[tuple[Kind, str], list[Rule]] = {}
    for rule in rules:
        found.setdefault((rule.kind, rule.local), []).append(rule)
    return found


def _shown(graph: Graph, roles: Mapping[Kind, Role]) -> dict[tuple[Kind, str], set[str]]:
    """Return the types that nodes other than proxies show, by kind and local name."""
    shown: dict[tuple[Kind, str], set[str]] = {}
    for end in sorted((end for end in graph if not end.is_proxy and end.type_name), key=lambda end: end.name):
        for kind, name, type_name in _things(end, roles):
            shown.setdefault((kind, name), set()).add(type_name)
    return shown


def _things(end: GraphEntity, roles: Mapping[Kind, Role]) -> Iterator[tuple[Kind, str, str]]:
    action = action_of(end)
    if action is not None and end.role is roles["action"]:
        yield "action", *action
    for kind in _PLAIN:  # the parts of an action are hidden names: no pattern means them
        if end.role is roles[kind]:
            yield kind, end.name, end.type_name
