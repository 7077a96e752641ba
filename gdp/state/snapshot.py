"""Snapshot of a node for a live view: its links, names, trees, flows and counts, short enough to be read every second.

Sans-I/O. A whole name would let every reader of a picture request the topic, so a snapshot holds the first
``ID_CHARS`` digits of it. Lists are bounded; ``left_out`` counts what they lack. The fields of a switch::

    {"role": "switch", "id": "75e…", "label": "edge", "domain": "0fc…", "domain_label": "lab", "uptime_s": 8.1,
     "links": [{"port": "s1", "to": "9ab…", "label": "cloud", "role": "switch", "rtt_ms": 0.4, "loss": 0.0, ...}],
     "names": [["c01…", "9ab…", "publish"], ...],                   name, node, right
     "trees": [["c01…", "9ab…", 1, "9ab…", ["77d…"]], ...],         name, publisher, path, from, to
     "clocks": [["9ab…", "cloud", 0.2, 0.4], ...],                  node, label, offset and its bound in ms
     "drops": {"no-route": 2}, "frames": {"in": 812, ...}, "waiting": [], "left_out": 0}
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Final, TypeVar

from gdp.control.link_state import Scope
from gdp.names import Name
from gdp.state.node_state import NodeState, SwitchState
from gdp.state.tables import rounded_ms
from gdp.telemetry.sources import DeviceCounts, NeighbourRow, Sources

if TYPE_CHECKING:  # a node loads its own core alone
    from gdp.client.participant import Participant
    from gdp.rib.core import RibCore
    from gdp.switch.core import SwitchCore

ID_CHARS: Final = 16  # 64 bits: no two names of one picture share them by accident
NAMES_MAX: Final = 1_000
TREES_MAX: Final = 400
FLOWS_MAX: Final = 400
LINKS_MAX: Final = 256
CLOCKS_MAX: Final = 64
SWITCHES_MAX: Final = 512  # of a topology
_FAN_OUT_MAX: Final = 64  # branches of one tree

_T = TypeVar("_T")


def short_id(name: Name) -> str:
    """Return the digits by which a snapshot knows a name."""
    return name.hex()[:ID_CHARS]


def node_snapshot(state: NodeState, sources: Sources, now_s: float) -> dict[str, object]:
    """Return the fields that every kind of node has, at a monotonic second."""
    identity, drops = state.identity, state.drops()
    counts = {"frames": sources.frames, "messages": sources.messages, "bytes": sources.message_bytes}
    waiting = {} if sources.waiting is None else sources.waiting()
    return {
        "role": identity.role.value,
        "id": short_id(identity.name),
        "label": identity.label,
        "domain": short_id(identity.root.domain),
        "domain_label": identity.root.label,
        "uptime_s": state.uptime_s(now_s),
        "drops": {reason.label: drops[reason] for reason in sorted(drops)},
        **{key: dict(source()) for key, source in counts.items() if source is not None},
        "clocks": [
            [short_id(member.name), member.label, rounded_ms(clock.offset_s), rounded_ms(clock.bound_s)]
            for member, clock in state.clocks[:CLOCKS_MAX]
        ],
        "waiting": [reason for reason, is_waiting in waiting.items() if is_waiting],
    }


def switch_snapshot(state: SwitchState) -> dict[str, object]:
    """Return the fields of a switch."""
    switch, up, devices = state.switch, list(state.neighbours(is_up=True)), state.devices()
    advertisements, trees = switch.attached.all(), switch.multicast.trees
    links = [_link(row, devices.get(row.port)) for row in up[:LINKS_MAX]]
    names = [
        [short_id(one.name), short_id(one.node), one.right.value]
        for one in (each.advertisement for each in advertisements[:NAMES_MAX])
    ]
    at = {(each.port, each.mac): short_id(each.name) for each in state.hello_protocol.neighbours.all_up()}
    shown = [
        [
            short_id(tree.topic),
            short_id(tree.publisher),
            tree.path,
            "" if tree.upstream is None else at.get(tree.upstream, ""),
            sorted({at[branch] for branch in islice(tree.branches, _FAN_OUT_MAX) if branch in at}),
        ]
        for tree in islice(trees.present(), TREES_MAX)
    ]
    return {
        "links": links,
        "names": names,
        "trees": shown,
        "rib": "" if switch.rib is None else short_id(switch.rib),
        "routes": len(switch.table),
        "link_states": len(switch.paths.link_states),
        "left_out": len(advertisements) - len(names) + len(trees) - len(shown) + len(up) - len(links),
    }


def _link(row: NeighbourRow, counts: DeviceCounts | None) -> dict[str, object]:
    return {
        "port": row.port,
        "to": short_id(row.name),
        "label": row.label,
        "role": row.role,
        "domain": short_id(row.domain),
        "rtt_ms": rounded_ms(row.rtt_s),
        "loss": max(row.loss_in, row.loss_out),
        "cost": row.cost,
        "mtu": row.mtu,
        "bytes_in": 0 if counts is None else counts.bytes_in,
        "bytes_out": 0 if counts is None else counts.bytes_out,
    }


def topology_snapshot(switch: SwitchCore) -> dict[str, object]:
    """Return all switches and links that a switch knows from link states; those of other machines, too."""
    states = [each for scope in Scope for each in switch.paths.link_states.states(scope)]
    rows = {
        (short_id(each.origin), short_id(each.domain)): [
            [short_id(link.name), short_id(link.domain), link.cost] for link in each.links
        ]
        for each in states[:SWITCHES_MAX]
    }
    return {
        "switches": [[switch_id, domain, links] for (switch_id, domain), links in rows.items()],
        "left_out": max(len(states) - SWITCHES_MAX, 0),
    }


def rib_snapshot(rib: RibCore, switch: Name | None) -> dict[str, object]:
    """Return the fields of a RIB; the names themselves are those of the switches."""
    return {"switch": _id_or_none(switch), "routes": rib.names, "watches": len(rib.state.outbox.watches)}


def member_snapshot(member: Participant, flows: Iterable[Mapping[str, object]] = ()) -> dict[str, object]:
    """Return the fields of a proxy, or of another participant.

    Args:
        flows: what the bridge carries: local names, types, and the first answers of servers.
    """
    advertisements = member.attachment.advertisements
    names = [
        [short_id(each.subject.name), each.right.value, "" if each.refused is None else each.refused.label]
        for each in advertisements[:NAMES_MAX]
    ]
    sent = {
        short_id(each.topic): {"messages": each.messages, "readers": each.readers}
        for each in islice(list(member.publications), FLOWS_MAX)
    }
    received: dict[str, dict[str, int]] = {}
    for proxy in islice(member.subscriptions.writer_proxies(), FLOWS_MAX):
        sums = received.setdefault(short_id(proxy.topic), {"messages": 0, "bytes": 0, "lost": 0, "publishers": 0})
        sums["messages"] += proxy.delivery.delivered
        sums["bytes"] += proxy.delivery.delivered_bytes
        sums["lost"] += proxy.losses.total
        sums["publishers"] += 1
    shown, left = _split(flows, FLOWS_MAX)
    switch = member.attachment.switch
    return {
        "switch": _id_or_none(None if switch is None else switch.name),
        "names": names,
        "sent": sent,
        "received": received,
        "flows": shown,
        "left_out": len(advertisements) - len(names) + left,
    }


def _id_or_none(name: Name | None) -> str | None:
    return None if name is None else short_id(name)


def _split(items: Iterable[_T], most: int) -> tuple[list[_T], int]:
    """Return at most so many items, and the number of the others."""
    every = list(items)
    return every[:most], max(len(every) - most, 0)
