"""Facts of a proxy about one name: the rules that name it, and what became of each.

I/O through the bridge, which it only reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from gdp.client.participant import Participant
from gdp.client.writer_proxy import WriterProxyState
from gdp.crypto.identity import Identity
from gdp.diagnosis.facts import FlowFact, ProxyFacts, WaitFact
from gdp.errors import RemoteError
from gdp.message.loss import by_label
from gdp.names import Name
from gdp.ros_names import ACTION_INFIX
from gdp.sansio import Timestamps
from gdp.trust.right import Right, right_on
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.bridge.core.desired_flows import ROLES
from proxy.bridge.core.node_rules import node_entity
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.imported_service import ImportedService
from proxy.bridge.imported_topic import ImportedTopic
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import GraphEntity

_FLOWS_MAX: Final = 16
_KNOWN_MAX: Final = 64
_SHORT_CHARS: Final = 16  # of a digest
_DETAIL_CHARS: Final = 200
_NAME_DIGITS: Final = 64

_RANKED_MAX: Final = 8
_PART: Final = {"topic": "", "service": "", "action": f"{ACTION_INFIX}send_goal", "node": ""}


class _Meant(NamedTuple):
    """A rule that the asked name is about, with local name, type and overlay name as far as they are known."""

    rule: Rule
    is_exposed: bool
    local: str
    type_name: str
    name: Name | None


def proxy_facts(
    bridge: Bridge,
    context: BridgeContext,
    identity: Identity,
    asked: str,
    now: Timestamps,
    *,
    waits: tuple[WaitFact, ...] = (),
    uptime_s: float = 0.0,
    with_known: bool = False,
    ros_domains: tuple[int, ...] = (),
) -> ProxyFacts:
    """Return what this proxy knows about a name.

    Args:
        asked: a local or a global ROS name, or 64 hex digits.
        with_known: add the names of rules and of the graph, for who runs this proxy.
        ros_domains: of the proxy's ROS 2 graphs.
    """
    graph = [end for each in bridge.graphs() for end in each]
    flows = [_flow_fact(bridge, context, identity, meant, graph, now) for meant in _meant(bridge, asked, graph)]
    member, switch = identity.member, context.member.attachment.switch
    return ProxyFacts(
        name=identity.name.to_text(),
        domain=member.domain.to_text(),
        switch="" if switch is None else switch.name.to_text(),
        unix_s=now.unix_s,
        uptime_s=round(uptime_s, 1),
        is_attached=context.member.attachment.is_attached,
        is_revoked=context.member.attachment.is_revoked,
        waits=waits,
        flows=tuple(flows[:_FLOWS_MAX]),
        known=tuple(_known(bridge, graph)) if with_known else (),
        entities=sum(not end.is_proxy for end in graph),
        ros_domains=ros_domains,
        valid_from_unix_s=float(member.not_before_unix_s),
        valid_until_unix_s=float(member.not_after_unix_s),
    )


def _known(bridge: Bridge, graph: Sequence[GraphEntity]) -> list[str]:
    rules = (*bridge.rules.expose, *bridge.rules.imports)
    names = {rule.local for rule in rules if not rule.is_pattern} | {end.name for end in graph if not end.is_proxy}
    return sorted(names)[:_KNOWN_MAX]


def _meant(bridge: Bridge, asked: str, graph: Sequence[GraphEntity]) -> list[_Meant]:
    """Return the rules that the asked name is about, each once for each type under which it is known."""
    found: dict[tuple[bool, str, str, str], _Meant] = {}
    brought = bridge.brought
    for is_exposed, rules in (
        (True, (*bridge.rules.expose, *brought.expose)),
        (False, (*bridge.rules.imports, *brought.imports)),
    ):
        for rule in rules:
            for each in _of_rule(bridge, rule, asked, graph, is_exposed=is_exposed):
                found.setdefault((is_exposed, rule.kind, each.local, str(each.name)), each)
    return list(found.values())


def _of_rule(
    bridge: Bridge, rule: Rule, asked: str, graph: Sequence[GraphEntity], *, is_exposed: bool
) -> Iterator[_Meant]:
    locals_ = _locals(bridge, rule, asked, graph)
    for local in locals_:
        types = {rule.type_name} if rule.type_name else _types(bridge, rule, local, graph, is_exposed=is_exposed)
        for type_name in sorted(types) or [""]:
            name = rule.overlay_name_of(local, type_name) if type_name else None
            if _is_hex(asked) and (name is None or name.to_text() != asked):
                continue
            yield _Meant(rule, is_exposed, local, type_name, name)


def _locals(bridge: Bridge, rule: Rule, asked: str, graph: Sequence[GraphEntity]) -> list[str]:
    """Return the local names of a rule that the asked text may mean."""
    if not _is_hex(asked):
        if rule.kind == "node" and rule.is_pattern:  # its nodes have one name
            return [rule.local] if rule.matches(asked) or asked == rule.name else []
        return [asked] if rule.matches(asked) else [rule.local] if asked == rule.name else []
    if not rule.is_pattern:
        return [rule.local]
    carried = {flow_spec.local for flow_spec, _ in bridge.flows if flow_spec.rule == rule}
    return sorted(carried | {end.name for end in graph if rule.matches(end.name)})


def _types(bridge: Bridge, rule: Rule, local: str, graph: Sequence[GraphEntity], *, is_exposed: bool) -> set[str]:
    carried = {spec.type_name for spec, _ in bridge.flows if (spec.rule, spec.local) == (rule, local)}
    if carried:
        return carried
    role = ROLES[is_exposed][rule.kind]
    return {end.type_name for end in graph if (end.name, end.role) == (local, role) and end.type_name}


def _flow_fact(
    bridge: Bridge,
    context: BridgeContext,
    identity: Identity,
    meant: _Meant,
    graph: Sequence[GraphEntity],
    now: Timestamps,
) -> FlowFact:
    rule, local, name = meant.rule, meant.local, meant.name
    right, role = right_on(rule.kind, gives=meant.is_exposed), ROLES[meant.is_exposed][rule.kind]
    meant_nodes = (end for end in graph if rule.kind == "node" and rule.matches(end.node))
    ends_here = {replace(node_entity(end), name=local) for end in meant_nodes} if rule.kind == "node" else graph
    under = [end for end in ends_here if (end.name, end.role) == (local + _PART[rule.kind], role) and not end.is_proxy]
    ends = [end for end in under if rule.kind == "action" or end.type_name in ("", meant.type_name)]
    faults = context.faults.of(local)
    problem = next((each for each in bridge.problems if each.local == local), None)
    flow, begun_s = (None if name is None else bridge.flow_of(rule, local, name)) or (None, now.mono_s)
    known: dict[str, object] = {
        "side": "expose" if meant.is_exposed else "import",
        "kind": rule.kind,
        "local": local,
        "type_name": meant.type_name,
        "owner": rule.owner.compressed.hex()[2 : 2 + _SHORT_CHARS],
        "digest": rule.metadata_of(local, meant.type_name).digest().hex()[:_SHORT_CHARS] if meant.type_name else "",
        "overlay": "" if name is None else name.to_text(),
        "is_carried": flow is not None,
        "problem": "" if problem is None else problem.fault.value,
        "detail": "" if problem is None else problem.detail[:_DETAIL_CHARS],
        "nodes": len(ends),
        "other_types": tuple(sorted({end.type_name for end in under} - {meant.type_name, ""}))[:4],
        "qos": tuple(sorted({f"{end.qos.reliability}, {end.qos.durability}" for end in ends if end.qos is not None})),
        "odd_qos": tuple(map(": ".join, flow.unmatched.values())) if isinstance(flow, ImportedTopic) else (),
        "right": right.value,
        "faults": {label: count for label, (count, _) in faults.items()},
        "details": {label: detail[:_DETAIL_CHARS] for label, (_, detail) in faults.items()},
        "max_hz": rule.max_hz,
        "max_bits_s": rule.max_bits_s,
        "deadline_ms": rule.deadline_ms,
        "age_s": round(now.mono_s - begun_s, 2),
    }
    if name is not None:
        known |= _rights(bridge, context.member, identity, name, right, now)
        known |= _overlay(context.member, name, right, now)
    if isinstance(flow, ExposedTopic):
        known |= _exposed(flow, now)
    elif isinstance(flow, ImportedTopic):
        flow.count_losses()
        known |= {
            "received": flow.stats.received,
            "thinned": flow.thinned,
            "lost": flow.stats.losses.by_label(),
            "idle_s": None if flow.last_s is None else round(now.mono_s - flow.last_s, 3),
        }
    elif isinstance(flow, ImportedService):
        known["ranking"] = tuple(flow.ranking(now.mono_s)[:_RANKED_MAX])
    return FlowFact(**known)  # type: ignore[arg-type]


def _rights(
    bridge: Bridge, member: Participant, identity: Identity, name: Name, right: Right, now: Timestamps
) -> dict[str, object]:
    """Return what is known of the delegation of a name, and of its advertisement."""
    topic = bridge.held.get(name)
    delegated, epochs = bridge.held.left_out.get(name, "no"), tuple[int, ...]()
    if topic is not None:
        epochs = tuple(sorted(topic.secrets))
        delegated = "yes"
        if right not in topic.delegation.rights:
            delegated = "lacks-right"
        else:
            try:
                topic.delegation.verify(identity, now.unix_s)
            except RemoteError as error:
                delegated = error.reason.label
    for each in member.attachment.advertisements:
        if (each.subject.name, each.right) == (name, right):
            state = "accepted" if each.is_taken else "refused" if each.refused is not None else "pending"
            refused = "" if each.refused is None else each.refused.label
            return {"delegated": delegated, "epochs": epochs, "advertised": state, "refused": refused}
    return {"delegated": delegated, "epochs": epochs}


def _overlay(member: Participant, name: Name, right: Right, now: Timestamps) -> dict[str, object]:
    """Return what is known of the far ends of a name."""
    del now
    proxies, subscription = member.subscriptions.writer_proxies_of(name), member.subscriptions.get(name)
    drops: dict[str, int] = {}
    for each in proxies:
        for reason, count in each.drops.items():
            drops[reason.label] = drops.get(reason.label, 0) + count
    known: dict[str, object] = {
        "writers": len(proxies),
        "live": sum(each.state is WriterProxyState.LIVE for each in proxies),
        "absent": 0 if subscription is None else len(subscription.absent),
        "is_reliable": not any(each.delivery.is_reliable is False for each in proxies),
        "drops": drops,
        "full_parts": sum(each.full_parts for each in proxies),
    }
    if right in (Right.SERVE, Right.CALL):
        known |= {
            "connected": len(member.services.peers(name)),
            "silent": len(member.services.silent_peers(name)),
            "readers": len(member.services.connected_peers(name)),
        }
    return known


def _exposed(flow: ExposedTopic, now: Timestamps) -> dict[str, object]:
    publisher = flow.publisher
    known: dict[str, object] = {
        "messages": flow.taken,
        "thinned": flow.thinned,
        "depth": flow.qos.depth,
        "idle_s": None if flow.last_s is None else round(now.mono_s - flow.last_s, 3),
    }
    if publisher is not None:
        known |= {
            "readers": publisher.readers,
            "sent": publisher.acknowledgements.sent,
            "lost": by_label(publisher.losses.counts),
            "is_reliable": publisher.confirms,
            "mtu": publisher.queue.mtu or 0,
            "is_throttled": publisher.governing_paths.is_limited(now.mono_s),
            "is_unconfirmed": publisher.sent_frames.is_unconfirmed,
        }
        if (governing := publisher.governing_paths.governing_reader()) is not None:
            reader, rtt_s, bytes_s = governing
            known |= {
                "governing": reader.to_text(),
                "governing_rtt_s": round(rtt_s, 4),
                "governing_bits_s": round(8 * bytes_s),
            }
    return known


def _is_hex(asked: str) -> bool:
    return len(asked) == _NAME_DIGITS and all(each in "0123456789abcdef" for each in asked)
