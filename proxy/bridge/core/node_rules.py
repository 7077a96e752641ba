"""Rules that a rule of kind ``node`` stands for: one for each topic, service and action of its nodes.

Sans-I/O. What an exposed node publishes or serves goes out, and what it subscribes to comes in. Of an imported node
only the former is taken: what leaves this machine is for its own rules to say. Clients are only described.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias

from gdp.config.offered_qos import OFFERED_DEPTH_MAX, OfferedQos
from gdp.ros_names import ACTION_INFIX, NODE_TYPE, Interface, is_of_every_node, prefixed, unprefixed
from proxy.bridge.core.action_interface import action_of, is_part
from proxy.config.brought_rule import BroughtRule
from proxy.config.matching import choose
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import Graph, GraphEntity, Role
from proxy.endpoints.core.qos import depth_of
from proxy.serial.channel import Qos
from proxy.wire.node import ENTITIES_MAX, NodeEntity

FarNodes: TypeAlias = Mapping[str, Graph]  # the nodes of other machines, by their names here, each with its entities
FarNode: TypeAlias = tuple[Rule, Graph]  # one of them: its rule and its entities
_PLAIN: Final[dict[Role, Interface]] = {Role.PUBLISHES: "topic", Role.SUBSCRIBES: "topic", Role.SERVES: "service"}


class Brought(NamedTuple):
    """Rules that nodes bring, by direction."""

    expose: list[Rule]
    imports: list[Rule]


def nodes_in(rules: Sequence[Rule], graph: Graph) -> dict[str, tuple[Rule, list[GraphEntity]]]:
    """Return the local nodes that rules of kind ``node`` mean, each with its rule and its entities."""
    found: dict[str, tuple[Rule, list[GraphEntity]]] = {}
    of_kind = [rule for rule in rules if rule.kind == "node"]
    for end in graph if of_kind else ():
        if end.node in found:
            found[end.node][1].append(end)
        elif end.node and not end.is_proxy and (rule := choose(of_kind, "node", end.node)) is not None:
            found[end.node] = rule, [end]
    return found


def node_entity(end: GraphEntity) -> GraphEntity:
    """Return the node of an entity, as if it were the server of its own name."""
    return GraphEntity(Role.SERVES, end.node, NODE_TYPE, end.node, end.node)


def local_node(rules: Sequence[Rule], shared: str) -> tuple[str, Rule] | None:
    """Return the name here of a far node, and its rule; None: no rule is about it."""
    for rule in sorted(rules, key=lambda rule: rule.is_pattern):
        own = unprefixed(rule.prefix, shared)
        local = None if own is None else own if rule.is_pattern else rule.local if own == rule.name else None
        if local is not None and rule.matches(local):
            return local, rule
    return None


def brought(expose: Sequence[Rule], graph: Graph, far: Iterable[FarNode]) -> Brought:
    """Return the rules of what local nodes have that a rule exposes, and of what far nodes publish or serve.

    Args:
        far: the entities of each node that is imported, with its rule.
    """
    rules = Brought([], [])
    for rule, ends in nodes_in(expose, graph).values():
        for is_other, each in rules_of_node(rule, ends, is_near=True):
            (rules.imports if is_other else rules.expose).append(each)
    for rule, far_ends in far:
        profiles = {end.name: end.qos for end in sorted(far_ends, key=repr) if end.role is Role.PUBLISHES}
        rules.imports.extend(each for is_other, each in rules_of_node(rule, far_ends, profiles) if not is_other)
    return rules


def rules_of_node(
    rule: Rule,
    ends: Iterable[GraphEntity],
    profiles: Mapping[str, Qos | None] = MappingProxyType({}),
    *,
    is_near: bool = False,
) -> Iterator[tuple[bool, Rule]]:
    """Yield the rule of each thing that a node has, and whether it goes in the other direction than the node.

    Args:
        profiles: what far publishers offer, by topic.
        is_near: the node is of this machine's graph.
    """
    by_node = BroughtRule.by(rule, is_near=is_near)
    found = {(end.role is Role.SUBSCRIBES, *thing) for end in ends if (thing := _thing(end)) is not None}
    for is_other, kind, name, type_name in sorted(found):
        if by_node.denied_by(name) is None:
            profile = None if is_other or kind != "topic" else profiles.get(name)
            offered = None if profile is None else _offered(profile)
            yield is_other, by_node.of(kind, name, type_name, offered)


def _offered(profile: Qos) -> OfferedQos:
    """Return what a publisher offers; it holds until its first message describes it."""
    return OfferedQos(
        reliability="best_effort" if profile.reliability == "best_effort" else "reliable",
        durability="transient_local" if profile.durability == "transient_local" else "volatile",
        depth=min(max(depth_of(profile), 1), OFFERED_DEPTH_MAX),
    )


def _thing(end: GraphEntity) -> tuple[Interface, str, str] | None:
    """Return kind, name and type of what crosses for this entity; None: nothing does."""
    if (action := action_of(end)) is not None and end.role is Role.SERVES:
        return "action", *action
    kind = _PLAIN.get(end.role)
    if kind is None or is_part(end.name) or not end.type_name:
        return None
    if end.role is Role.SUBSCRIBES and is_of_every_node("topic", end.name):
        return None  # it hears this graph's; another machine's would look like its own
    return kind, end.name, end.type_name


def described(rule: Rule, ends: Iterable[GraphEntity]) -> tuple[NodeEntity, ...]:
    """Return a node's entities for other machines, without denied ones."""
    by_node = BroughtRule.by(rule)
    found = {
        NodeEntity(end.role, prefixed(rule.prefix, end.name), end.type_name, end.qos)
        for end in ends
        if end.type_name and by_node.denied_by(_whole(end.name)) is None
    }
    found_in_order = sorted(found, key=lambda each: (each.role.value, each.name, each.type_name, repr(each.qos)))
    return tuple(found_in_order[:ENTITIES_MAX])


def local_ends(rule: Rule, node: str, entities: Iterable[NodeEntity]) -> Iterator[GraphEntity]:
    """Yield a far node's entities as they appear here, without denied ones and those outside the rule's namespace."""
    by_node = BroughtRule.by(rule)
    for role, shared, type_name, qos in entities:
        name = unprefixed(rule.prefix, shared)
        if name is not None and by_node.denied_by(_whole(name)) is None:
            yield GraphEntity(role, name, type_name, node, "", qos=qos)


def _whole(name: str) -> str:
    """Return the name of the action that a name is a part of; other names are kept."""
    return name.partition(ACTION_INFIX)[0]
