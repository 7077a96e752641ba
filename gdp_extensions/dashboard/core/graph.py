"""Graph of a live view: nodes, links, names and clusters, merged from the readings of one poll.

Sans-I/O. Two ends describe a link, several nodes a name; each says what it knows::

    switch   its links with quality, the names that attached nodes advertise, its part of every tree
    proxy    its flows with local names and types, messages sent and received, first answers of servers
    RIB      its counts
    topology the switches and links of other machines, from link states
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from gdp_extensions.dashboard.core.readings import Reading, flag_of, items_of, map_of, number_of, rows_of, text_of

_SWITCHES: Final = frozenset(("switch", "leaf"))
_ENDS: Final = {"publish": "publishers", "read": "readers", "serve": "servers", "call": "clients"}


@dataclass(slots=True, kw_only=True)
class Node:
    """One node; ``is_near``: its control socket was read, so that its own counts are known."""

    id: str
    role: str
    label: str = ""
    domain: str = ""
    is_near: bool = False
    waiting: tuple[str, ...] = ()
    clocks: tuple[Sequence[object], ...] = ()  # of others: id, label, what they are ahead and its bound, in ms


@dataclass(slots=True, kw_only=True)
class Link:
    """One pair of neighbours, with all their links taken together.

    Attributes:
        a, b: their ids, ``a`` the smaller.
        ab_bytes, ba_bytes: bytes from ``a`` to ``b``, and back, since the devices exist.
        rtt_ms: the smallest measured; None: not measured.
        loss: the largest share that either end measured.
    """

    a: str
    b: str
    ports: list[str] = field(default_factory=list)
    ab_bytes: float = 0.0
    ba_bytes: float = 0.0
    rtt_ms: float | None = None
    loss: float = 0.0
    cost: float = 0.0
    mtu: float = 0.0
    _seen: set[tuple[str, str]] = field(default_factory=set)

    def add_end(self, end: str, fields: Mapping[str, object]) -> None:
        """Add what one end says of it."""
        port = text_of(fields, "port")
        if (end, port) in self._seen:
            return
        self._seen.add((end, port))
        self.ports.append(port)
        sent, received = number_of(fields, "bytes_out"), number_of(fields, "bytes_in")
        ab, ba = (sent, received) if end == self.a else (received, sent)
        is_second_end = any(other != end for other, _ in self._seen)
        if is_second_end:  # both ends count the same bytes
            self.ab_bytes, self.ba_bytes = max(self.ab_bytes, ab), max(self.ba_bytes, ba)
        else:
            self.ab_bytes, self.ba_bytes = self.ab_bytes + ab, self.ba_bytes + ba
        if isinstance(rtt_ms := fields.get("rtt_ms"), int | float):
            self.rtt_ms = rtt_ms if self.rtt_ms is None else min(self.rtt_ms, rtt_ms)
        self.loss = max(self.loss, number_of(fields, "loss"))
        self.cost, self.mtu = number_of(fields, "cost"), number_of(fields, "mtu")


@dataclass(slots=True, kw_only=True)
class NameEntry:
    """One name: who uses it, its trees as (publisher, path, switch, from, to), and who controls it at a reader."""

    id: str
    label: str = ""
    kind: str = ""
    type: str = ""
    publishers: set[str] = field(default_factory=set)
    readers: set[str] = field(default_factory=set)
    servers: set[str] = field(default_factory=set)
    clients: set[str] = field(default_factory=set)
    holders: set[str] = field(default_factory=set)
    trees: list[tuple[str, int, str, str, tuple[str, ...]]] = field(default_factory=list)
    sent: float = 0.0
    received: float = 0.0
    lost: float = 0.0

    def ends(self, rights: str) -> set[str]:
        """Return the nodes of one list of its ends."""
        return {
            "publishers": self.publishers, "readers": self.readers, "servers": self.servers, "clients": self.clients,
        }[rights]  # fmt: skip


@dataclass(frozen=True, slots=True)
class ServerSeen:
    """One server of a name as one client sees it; ``first``: calls that it answered first."""

    name: str
    client: str
    server: str
    is_there: bool
    first: float


@dataclass(slots=True)
class Graph:
    """Everything that one poll found."""

    nodes: dict[str, Node] = field(default_factory=dict)
    domains: dict[str, str] = field(default_factory=dict)
    links: dict[tuple[str, str], Link] = field(default_factory=dict)
    names: dict[str, NameEntry] = field(default_factory=dict)
    replicas: list[ServerSeen] = field(default_factory=list)
    drops: dict[tuple[str, str], float] = field(default_factory=dict)  # node and reason
    counts: dict[str, float] = field(default_factory=dict)
    clusters: list[Mapping[str, object]] = field(default_factory=list)
    reports: list[Mapping[str, object]] = field(default_factory=list)  # events of supervisors
    left_out: int = 0

    def node(self, node_id: str, role: str) -> Node:
        """Return a node, made if necessary."""
        return self.nodes.setdefault(node_id, Node(id=node_id, role=role))

    def name(self, name_id: str) -> NameEntry:
        """Return a name, made if necessary."""
        return self.names.setdefault(name_id, NameEntry(id=name_id))

    def link(self, one: str, other: str) -> Link:
        """Return the link of a pair, made if necessary."""
        a, b = min(one, other), max(one, other)
        return self.links.setdefault((a, b), Link(a=a, b=b))


def merge_readings(readings: Iterable[Reading]) -> Graph:
    """Return the graph that the readings describe together."""
    graph = Graph()
    every = list(readings)
    for each in (each for each in every if each.is_node):
        _add_node(graph, each)
    for each in every:
        if not each.is_node:
            graph.clusters += items_of(each.fields, "clusters")
            graph.reports += items_of(each.fields, "events")
            continue
        _add_links(graph, each)
        _add_names(graph, each)
        _add_trees(graph, each)
        _add_flows(graph, each)
        _add_counts(graph, each)
        _add_topology(graph, each)
    return graph


def _add_node(graph: Graph, reading: Reading) -> None:
    fields = reading.fields
    node = graph.node(reading.id, reading.role)
    node.label, node.domain, node.is_near = text_of(fields, "label"), text_of(fields, "domain"), True
    waiting = fields.get("waiting")
    node.waiting = tuple(map(str, waiting)) if isinstance(waiting, list) else ()
    node.clocks = tuple(row for row in rows_of(fields, "clocks", 4) if all(isinstance(each, float) for each in row[2:]))
    graph.domains[node.domain] = text_of(fields, "domain_label")
    graph.left_out += int(number_of(fields, "left_out"))


def _add_links(graph: Graph, reading: Reading) -> None:
    for each in items_of(reading.fields, "links"):
        other = text_of(each, "to")
        if not other:
            continue
        node = graph.node(other, text_of(each, "role"))
        node.label = node.label or text_of(each, "label")
        node.domain = node.domain or text_of(each, "domain")
        graph.domains.setdefault(node.domain, "")
        graph.link(reading.id, other).add_end(reading.id, each)


def _add_names(graph: Graph, reading: Reading) -> None:
    if reading.role not in _SWITCHES:
        for name, right, refused in rows_of(reading.fields, "names", 3):
            if not refused:
                _add_end(graph, str(name), reading.id, str(right))
        return
    for name, node, right in rows_of(reading.fields, "names", 3):
        graph.node(str(node), "proxy")
        _add_end(graph, str(name), str(node), str(right))


def _add_end(graph: Graph, name: str, node: str, right: str) -> None:
    if right in _ENDS:
        entry = graph.name(name)
        entry.ends(_ENDS[right]).add(node)
        entry.kind = entry.kind or ("service" if right in ("serve", "call") else "topic")


def _add_trees(graph: Graph, reading: Reading) -> None:
    for name, publisher, path, upstream, branches in rows_of(reading.fields, "trees", 5):
        entry = graph.names.get(str(name))
        if entry is None:
            entry = graph.name(str(name))
        to = tuple(map(str, branches)) if isinstance(branches, list) else ()
        number = path if isinstance(path, int) else 1
        entry.trees.append((str(publisher), number, reading.id, str(upstream), to))


def _add_flows(graph: Graph, reading: Reading) -> None:
    for each in items_of(reading.fields, "flows"):
        entry = graph.name(text_of(each, "name"))
        entry.label = entry.label or text_of(each, "local")
        entry.type, entry.kind = text_of(each, "type"), text_of(each, "kind") or entry.kind
        if holder := text_of(each, "holder"):
            entry.holders.add(holder)
        for server in items_of(each, "servers"):
            there, first = flag_of(server, "is_there"), number_of(server, "first")
            graph.replicas.append(ServerSeen(entry.id, reading.id, text_of(server, "id"), there, first))
    for key, attribute in (("sent", "sent"), ("received", "received")):
        for name, value in map_of(reading.fields, key).items():
            if isinstance(value, Mapping) and name in graph.names:
                entry = graph.names[name]
                setattr(entry, attribute, getattr(entry, attribute) + number_of(value, "messages"))
                entry.lost += number_of(value, "lost")


def _add_counts(graph: Graph, reading: Reading) -> None:
    for reason, count in map_of(reading.fields, "drops").items():
        if isinstance(count, int | float):
            graph.drops[reading.id, reason] = count
    messages = map_of(reading.fields, "messages")
    for key in ("in", "out"):
        graph.counts[f"messages_{key}"] = graph.counts.get(f"messages_{key}", 0.0) + number_of(messages, key)


def _add_topology(graph: Graph, reading: Reading) -> None:
    for switch, domain, links in rows_of(reading.topology, "switches", 3):
        node = graph.node(str(switch), "switch")
        node.domain = node.domain or str(domain)
        graph.domains.setdefault(node.domain, "")
        for each in links if isinstance(links, list) else ():
            if isinstance(each, list) and len(each) == 3:
                other = graph.node(str(each[0]), "switch")
                other.domain = other.domain or str(each[1])
                link = graph.link(str(switch), str(each[0]))
                link.cost = link.cost or (float(each[2]) if isinstance(each[2], int | float) else 0.0)
