"""Facts about one name, as nodes and the host of the asker know them.

Sans-I/O. Every class has a JSON form (``fields.py``). Names are 64 hex digits, times are seconds. Counters begin with
the node; ``since`` subtracts an earlier sample, so that only what happens now counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace


@dataclass(frozen=True, slots=True, kw_only=True)
class WaitFact:
    """What a node waits for.

    Attributes:
        reason: value of ``WaitReason``.
        device: network device concerned.
        domain: label of a refused neighbour's domain, unproven.
        neighbour: name of the node that was heard there last.
        refused: label of the reason of a refusal.
    """

    reason: str
    device: str = ""
    neighbour: str = ""
    domain: str = ""
    refused: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowFact:
    """One rule of a proxy about the name, and what became of it.

    Attributes:
        side: ``expose`` or ``import``.
        owner: fingerprint of the owner's key, 16 hex digits.
        digest: of the metadata, 16 hex digits.
        is_carried: the flow exists.
        problem: label of the fault that keeps the flow from existing.
        nodes: local nodes of the other role: publishers, subscribers, servers or clients.
        other_types: types under which local nodes use the same local name.
        qos: reliability and durability of local nodes, such as ``reliable, transient_local``.
        is_reliable: lost frames are repeated, says the publisher.
        depth: messages of an exposed topic that are kept for late joiners.
        odd_qos: why the QoS of a local node matches nothing.
        right: the right that the rule needs.
        delegated: ``yes``, ``no``, ``lacks-right``, or the label of the reason why the delegation is not valid.
        epochs: key epochs whose secrets are held.
        advertised: ``accepted``, ``pending``, ``refused``, ``none``.
        refused: label of the reason.
        faults: occurrences about the local name by label; ``details`` has the newest text of each.
        readers: far readers, or connected far clients.
        writers: far publishers or servers that this node knows; ``live``: those that were heard.
        absent: far publishers whose route ended and that may return.
        connected: far servers that keep up; ``silent``: far servers that stopped to report.
        ranking: far servers in the order of their paths' costs, where requests go to the nearest: name and reason.
        messages: local messages taken for the overlay; ``sent``: of these, what left.
        received: messages of the overlay that were published here.
        full_parts: fragments of full size that came, of messages that need several.
        thinned: messages left out for the rule's ``max_hz``.
        lost: messages lost by reason; ``drops``: frames dropped by reason.
        idle_s: since the last message; None: there was none.
        age_s: since the flow began.
        is_throttled: messages wait for the rule's ``max_bits_s`` now.
        is_unconfirmed: frames of messages have left, and no report shows so far what became of them.
        governing: the far reader that governs the pace of an exposed topic; empty: one reader, or nothing measured.
        governing_rtt_s: round trip of its path; ``governing_bits_s``: what that path permits.
    """

    side: str
    kind: str
    local: str
    type_name: str = ""
    owner: str = ""
    digest: str = ""
    overlay: str = ""
    is_carried: bool = False
    problem: str = ""
    detail: str = ""
    nodes: int = 0
    other_types: tuple[str, ...] = ()
    qos: tuple[str, ...] = ()
    odd_qos: tuple[str, ...] = ()
    is_reliable: bool = True
    depth: int = 0
    right: str = ""
    delegated: str = "no"
    epochs: tuple[int, ...] = ()
    advertised: str = "none"
    refused: str = ""
    faults: Mapping[str, int] = field(default_factory=dict)
    details: Mapping[str, str] = field(default_factory=dict)
    max_hz: float | None = None
    max_bits_s: float | None = None
    deadline_ms: float | None = None
    readers: int = 0
    writers: int = 0
    live: int = 0
    absent: int = 0
    connected: int = 0
    silent: int = 0
    ranking: tuple[str, ...] = ()
    messages: int = 0
    sent: int = 0
    received: int = 0
    full_parts: int = 0
    thinned: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)
    drops: Mapping[str, int] = field(default_factory=dict)
    idle_s: float | None = None
    age_s: float = 0.0
    mtu: int = 0
    is_throttled: bool = False
    is_unconfirmed: bool = False
    governing: str = ""
    governing_rtt_s: float = 0.0
    governing_bits_s: float = 0.0

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Return what tells flows of one proxy apart."""
        return self.side, self.kind, self.local, self.overlay

    def since(self, before: FlowFact) -> FlowFact:
        """Return the same with the counters of the time since an earlier sample."""
        return replace(
            self,
            faults=_minus(self.faults, before.faults),
            messages=max(self.messages - before.messages, 0),
            sent=max(self.sent - before.sent, 0),
            received=max(self.received - before.received, 0),
            full_parts=max(self.full_parts - before.full_parts, 0),
            thinned=max(self.thinned - before.thinned, 0),
            lost=_minus(self.lost, before.lost),
            drops=_minus(self.drops, before.drops),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ProxyFacts:
    """A proxy: its attachment, and its flows of the name.

    Attributes:
        is_near: the asker runs it.
        is_revoked: it has learnt that its own membership is revoked.
        known: local names of rules and of the graph; only for who runs the proxy.
        entities: other nodes' entities in its graphs; None: it has no live graph.
        ros_domains: of its ROS 2 graphs.
        valid_from_unix_s: begin of its membership; ``valid_until_unix_s``: its end.
    """

    name: str
    is_near: bool = False
    domain: str = ""
    switch: str = ""
    unix_s: float = 0.0
    uptime_s: float = 0.0
    is_attached: bool = False
    is_revoked: bool = False
    waits: tuple[WaitFact, ...] = ()
    flows: tuple[FlowFact, ...] = ()
    known: tuple[str, ...] = ()
    entities: int | None = None
    ros_domains: tuple[int, ...] = ()
    valid_from_unix_s: float = 0.0
    valid_until_unix_s: float = 0.0

    def since(self, before: ProxyFacts) -> ProxyFacts:
        """Return the same with the counters of the time since an earlier sample."""
        known = {each.key: each for each in before.flows}
        flows = (each.since(known[each.key]) if each.key in known else each for each in self.flows)
        return replace(self, flows=tuple(flows))


@dataclass(frozen=True, slots=True, kw_only=True)
class LocationFact:
    """An advertiser of the name as a switch knows it; ``is_reachable``: a path leads to its switch."""

    advertiser: str
    right: str
    switch: str
    domain: str = ""
    is_reachable: bool = True
    is_trusted: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class TunnelFact:
    """A tunnel of a switch.

    Attributes:
        handshake_age_s: since the last handshake; None: there was none.
        endpoint: address of the peer; empty: it has sent nothing and none is configured.
    """

    peer: str
    device: str = ""
    is_up: bool = False
    handshake_age_s: float | None = None
    endpoint: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SwitchFacts:
    """A switch, and what it knows about the name.

    Attributes:
        rib: the RIB in use; empty: none is known.
        is_rib_silent: that RIB owes an answer for too long.
        attached: nodes attached here that advertise the name, as ``name right``.
        is_negative: the RIB said that no node advertises the name.
        reaches: switches of its domain to which a path leads; empty: not stated.
        proxies: proxies attached here.
        readers: nodes attached here that read the name; ``branches``: where its trees lead from here.
        is_joined: a tree of the name gets its messages from a neighbour, or from a publisher attached here.
    """

    name: str
    is_near: bool = False
    domain: str = ""
    unix_s: float = 0.0
    uptime_s: float = 0.0
    valid_from_unix_s: float = 0.0
    valid_until_unix_s: float = 0.0
    rib: str = ""
    is_rib_silent: bool = False
    waits: tuple[WaitFact, ...] = ()
    neighbours: tuple[str, ...] = ()
    reaches: tuple[str, ...] = ()
    proxies: tuple[str, ...] = ()
    attached: tuple[str, ...] = ()
    locations: tuple[LocationFact, ...] = ()
    is_negative: bool = False
    readers: int = 0
    branches: int = 0
    is_joined: bool = False
    tunnels: tuple[TunnelFact, ...] = ()
    drops: Mapping[str, int] = field(default_factory=dict)
    pending: int = 0

    def since(self, before: SwitchFacts) -> SwitchFacts:
        """Return the same with the counters of the time since an earlier sample."""
        return replace(self, drops=_minus(self.drops, before.drops))


@dataclass(frozen=True, slots=True, kw_only=True)
class RouteFact:
    """A stored route of the name."""

    advertiser: str
    right: str
    switch: str = ""
    domain: str = ""
    lease_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GoneFact:
    """A former advertiser: it ``withdrew``, or its lease ``lapsed``; ``switch``: where it was attached."""

    advertiser: str
    how: str
    switch: str = ""
    domain: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RibFacts:
    """A RIB, and what it knows about the name.

    Attributes:
        refused: reason of the newest refusal of an advertisement of the name; empty: there was none.
    """

    name: str
    is_near: bool = False
    domain: str = ""
    unix_s: float = 0.0
    is_attached: bool = True
    waits: tuple[WaitFact, ...] = ()
    routes: tuple[RouteFact, ...] = ()
    gone: tuple[GoneFact, ...] = ()
    refused: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RosProcess:
    """A process of this host that uses ROS.

    Attributes:
        domain: its ``ROS_DOMAIN_ID``.
        transports: its ``FASTDDS_BUILTIN_TRANSPORTS``, empty by default.
        is_apart: in another network namespace than the proxy.
    """

    pid: int
    command: str
    domain: int = 0
    transports: str = ""
    is_apart: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Unreachable:
    """A node that did not answer; ``is_down``: it runs on this host no more."""

    role: str
    where: str
    why: str
    is_down: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """All that is known to answer about one name.

    Attributes:
        asked: the name as the user typed it.
        window_s: time between the two samples of the counters; 0: there was one only.
        graph_domain: ``ROS_DOMAIN_ID`` of the near proxy's graph; None: it has none.
    """

    asked: str
    proxies: tuple[ProxyFacts, ...] = ()
    switches: tuple[SwitchFacts, ...] = ()
    ribs: tuple[RibFacts, ...] = ()
    processes: tuple[RosProcess, ...] = ()
    unreachable: tuple[Unreachable, ...] = ()
    window_s: float = 0.0
    graph_domain: int | None = None

    def since(self, before: Facts, window_s: float) -> Facts:
        """Return the same with the counters of the time since an earlier sample."""
        proxies = {each.name: each for each in before.proxies}
        switches = {each.name: each for each in before.switches}
        return replace(
            self,
            proxies=tuple(each.since(proxies.get(each.name, each)) for each in self.proxies),
            switches=tuple(each.since(switches.get(each.name, each)) for each in self.switches),
            window_s=window_s,
        )


def _minus(now: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    return {key: count - before.get(key, 0) for key, count in now.items() if count > before.get(key, 0)}
