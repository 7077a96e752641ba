"""Required delegations: those of one owner that the rules of several machines need.

Sans-I/O. A machine needs the right to publish or serve for its exposed names, and the right to read or call for its
imported names. A pattern, and a rule without a type, match known names: from rules of any machine, from earlier
delegations, from live graphs.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from gdp.crypto.keys import PublicKey
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.ros_names import NODE_TYPE
from gdp.trust.delegation import Delegation
from gdp.trust.right import Right, right_on
from proxy.bridge.core.desired_flows import FlowSpec, exposed, imported
from proxy.bridge.core.node_rules import nodes_in, rules_of_node
from proxy.config import matching
from proxy.config.config import ProxyConfig
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import Graph

_GIVES = frozenset({Right.PUBLISH, Right.SERVE})


class RequiredDelegation(NamedTuple):
    """Right that one node needs for one name."""

    name: Name
    metadata: Metadata
    rights: frozenset[Right]


class Machine(NamedTuple):
    """Known state of one machine.

    Args:
        graphs: live graphs, in the order of the configuration's ``ros``; empty: they were not observed.
    """

    config: ProxyConfig
    held: Sequence[Delegation] = ()
    graphs: Sequence[Graph] = ()


def needs(machines: Sequence[Machine], owner: PublicKey) -> list[list[RequiredDelegation]]:
    """Return the needs of each machine, sorted by kind and ROS name."""
    offers = [_offered(machine, owner) for machine in machines]
    everywhere = {name: metadata for each in offers for name, metadata in each.items()}
    brought = defaultdict[Name, list[tuple[bool, Rule]]](list)
    for name, rules in (each for machine in machines for each in _brought(machine, owner)):
        brought[name] += rules
    return [
        _of_machine(machine.config, own, {**everywhere, **_asked(machine, owner)}, brought)
        for machine, own in zip(machines, offers, strict=True)
    ]


def unmet(rules: Iterable[Rule], owner: PublicKey, found: Iterable[RequiredDelegation]) -> list[Rule]:
    """Return the rules of this owner without any match."""
    known = [each.metadata for each in found]
    return [rule for rule in _of(rules, owner) if all(rule.local_of(metadata) is None for metadata in known)]


def _of_machine(
    config: ProxyConfig,
    offered: Mapping[Name, Metadata],
    wanted: Mapping[Name, Metadata],
    brought: Mapping[Name, Sequence[tuple[bool, Rule]]],
) -> list[RequiredDelegation]:
    rights: dict[Name, set[Right]] = {}
    for rules, known, is_exposed in ((config.expose, offered, True), (config.imports, wanted, False)):
        for name, metadata in known.items():
            if matching.imported(rules, name, metadata) is not None:
                rights.setdefault(name, set()).add(right_on(metadata["kind"], gives=is_exposed))
    both = {**wanted, **offered}
    for node in rights.keys() & brought.keys():
        has_node = Right.SERVE in rights[node]
        for is_heard, rule in brought[node]:  # a machine that imports the node gives what it hears by a rule of its own
            name, metadata = rule.overlay_name, rule.overlay_metadata
            is_exposed = has_node is not is_heard
            if has_node or not is_heard or matching.imported(config.expose, name, metadata) is not None:
                rights.setdefault(name, set()).add(right_on(metadata["kind"], gives=is_exposed))
                both[name] = metadata
    found = [RequiredDelegation(name, both[name], frozenset(each)) for name, each in rights.items()]
    return sorted(found, key=lambda need: (str(need.metadata["kind"]), str(need.metadata["name"])))


def _offered(machine: Machine, owner: PublicKey) -> dict[Name, Metadata]:
    """Return what a machine offers: from its rules, its delegations and its live graphs."""
    config = machine.config
    known = dict(_stated(config.expose, owner))
    for delegation in machine.held:
        metadata = delegation.metadata
        if metadata is not None and delegation.rights & _GIVES and metadata.name(owner.compressed) == delegation.name:
            known[delegation.name] = metadata
    for at, graph in enumerate(machine.graphs):
        known |= _live(exposed(_rules_at(config, config.expose, at), graph, []), owner)
    return known


def _brought(machine: Machine, owner: PublicKey) -> Iterator[tuple[Name, list[tuple[bool, Rule]]]]:
    """Yield the name of each node that a machine exposes, with the rules of what it has, and whether it hears that."""
    for at, graph in enumerate(machine.graphs):
        rules = _of(_rules_at(machine.config, machine.config.expose, at), owner)
        for rule, ends in nodes_in(list(rules), graph).values():
            yield rule.overlay_name_of(rule.local, NODE_TYPE), list(rules_of_node(rule, ends))


def _asked(machine: Machine, owner: PublicKey) -> dict[Name, Metadata]:
    """Return what a machine requests: from its rules and its live graphs."""
    config = machine.config
    known = dict(_stated(config.imports, owner))
    for at, graph in enumerate(machine.graphs):
        known |= _live(imported(_rules_at(config, config.imports, at), graph, (), []), owner)
    return known


def _stated(rules: Iterable[Rule], owner: PublicKey) -> Iterator[tuple[Name, Metadata]]:
    for rule in _of(rules, owner):
        if not rule.is_pattern and rule.type_name and not rule.is_denied:
            yield rule.overlay_name, rule.overlay_metadata


def _live(flow_specs: Iterable[FlowSpec], owner: PublicKey) -> dict[Name, Metadata]:
    ours = (flow_spec for flow_spec in flow_specs if flow_spec.rule.owner.compressed == owner.compressed)
    return {flow_spec.name: flow_spec.rule.metadata_of(flow_spec.local, flow_spec.type_name) for flow_spec in ours}


def _of(rules: Iterable[Rule], owner: PublicKey) -> Iterator[Rule]:
    return (rule for rule in rules if rule.owner.compressed == owner.compressed)


def _rules_at(config: ProxyConfig, rules: Iterable[Rule], at: int) -> list[Rule]:
    return [rule for rule in rules if config.endpoint_of(rule) == at]
