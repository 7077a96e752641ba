"""Scene of a live view over time: what a page shows, rates, events, and fifteen minutes of history.

Sans-I/O; ``now_s`` is monotonic, ``unix_s`` the wall clock. A page gets two parts. The *structure* changes when
something comes or goes; its lists give every thing a number. The *figures* of each second refer to these numbers, so
that thousands of idle names cost nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final

from gdp_extensions.dashboard.core.graph import Graph, Link, NameEntry, merge_readings
from gdp_extensions.dashboard.core.readings import Reading, number_of, text_of
from gdp_extensions.dashboard.core.series import SeriesStore

EVENTS_MAX: Final = 400
_EVENT_AGE_S: Final = 900.0
_LISTED_MAX: Final = 4  # names of one node that come or go at once and are listed one by one
_RATE_S: Final = 4.0  # over which a rate is the mean: a slow topic has few messages a poll
_DROP_PAUSE_S: Final = 10.0  # between two events about one reason at one node


class Scene:
    """The present graph with its rates, and what happened; ``version``: rises when the structure changes."""

    def __init__(self) -> None:
        self.version = 0
        self.graph = Graph()
        self._structure: dict[str, object] = {}
        self._series = SeriesStore()
        self._events: deque[dict[str, object]] = deque(maxlen=EVENTS_MAX)
        self._event_number = 0
        self._before_s: float | None = None
        self._totals: dict[str, float] = {}  # the last value of each counter
        self._rates: dict[str, float] = {}
        self._recent = deque[tuple[float, dict[str, float]]]()  # seconds of each poll, and what was counted in it
        self._drop_events: dict[tuple[str, str], float] = {}
        self._reports_seen = 0.0
        self._unix_s = 0.0

    def update(self, readings: Iterable[Reading], now_s: float, unix_s: float) -> None:
        """Take the readings of one poll."""
        graph = merge_readings(readings)
        is_first = self._before_s is None
        elapsed_s = 1.0 if self._before_s is None else max(now_s - self._before_s, 1e-3)
        self._before_s, self._unix_s = now_s, unix_s
        self._rates = self._rates_of(graph, elapsed_s)
        if not is_first:
            self._tell_changes(graph)
            self._tell_drops(now_s, graph)
        self._tell_reports(graph)
        while self._events and unix_s - number_of(self._events[0], "unix_s") > _EVENT_AGE_S:
            self._events.popleft()
        self.graph = graph
        structure = _structure_of(graph)
        if structure != self._structure:
            self.version += 1
            self._structure = structure
        self._series.add(self._samples(graph))

    def structure(self) -> dict[str, object]:
        """Return the structure for a page."""
        return {"kind": "structure", "version": self.version, **self._structure}

    def figures(self, after_event: int) -> dict[str, object]:
        """Return the figures of the last poll, and the events after one."""
        graph, rates = self.graph, self._rates
        links = [self._link_row(each) for each in graph.links.values()]
        names = {
            str(at): [round(rates.get(f"name {each.id}", 0.0), 2), each.lost]
            for at, each in enumerate(graph.names.values())
            if rates.get(f"name {each.id}") or each.lost
        }
        by_rate = [
            (rates.get(f"drop {node} {reason}", 0.0), count, node, reason)
            for (node, reason), count in graph.drops.items()
        ]
        drops = [[node, reason, count, round(rate, 2)] for rate, count, node, reason in sorted(by_rate, reverse=True)]
        replicas = [
            [each.name, each.client, each.server, each.is_there, each.first,
             round(rates.get(f"first {each.name} {each.client} {each.server}", 0.0), 2)]
            for each in graph.replicas
        ]  # fmt: skip
        return {
            "kind": "figures",
            "version": self.version,
            "unix_s": round(self._unix_s, 3),
            "links": links,
            "names": names,
            "drops": drops,
            "replicas": replicas,
            "waiting": {node.id: list(node.waiting) for node in graph.nodes.values() if node.waiting},
            "clocks": {node.id: list(node.clocks) for node in graph.nodes.values() if node.clocks},
            "totals": self._totals_of(graph),
            "events": [each for each in self._events if number_of(each, "number") > after_event],
        }

    def name_detail(self, name: str) -> dict[str, object]:
        """Return the trees of one name."""
        entry = self.graph.names.get(name)
        trees = [] if entry is None else [list(each) for each in entry.trees]
        return {"kind": "name", "id": name, "trees": trees}

    def history(self, key: str) -> dict[str, object]:
        """Return the samples of a series, one a second, the newest last.

        Args:
            key: ``total bytes``, ``total messages``, ``total drops``, ``total rtt``, ``link A B``, ``rtt A B``,
                ``name ID`` or ``drop NODE``.
        """
        return {"kind": "history", "key": key, "samples": self._series.samples(key)}

    def _link_row(self, link: Link) -> list[float | None]:
        key = _link_key(link)
        there, back = (round(self._rates.get(f"{key}{way}", 0.0), 1) for way in "><")
        return [there, back, link.rtt_ms, round(link.loss, 4)]

    def _rates_of(self, graph: Graph, elapsed_s: float) -> dict[str, float]:
        totals: dict[str, float] = {}
        for link in graph.links.values():
            totals[f"{_link_key(link)}>"], totals[f"{_link_key(link)}<"] = link.ab_bytes, link.ba_bytes
        for name in graph.names.values():
            totals[f"name {name.id}"] = name.sent or name.received
        for (node, reason), count in graph.drops.items():
            totals[f"drop {node} {reason}"] = count
        for each in graph.replicas:
            key = f"first {each.name} {each.client} {each.server}"
            totals[key] = totals.get(key, 0.0) + each.first
        totals |= graph.counts
        before, self._totals = self._totals, totals
        # A restarted node counts from zero again, which is no negative rate.
        counted = {key: value - before[key] for key, value in totals.items() if key in before and value > before[key]}
        if not before:
            return {}
        self._recent.append((elapsed_s, counted))
        while sum(each for each, _ in self._recent) - self._recent[0][0] >= _RATE_S:
            self._recent.popleft()
        sums: dict[str, float] = {}
        for _, recent in self._recent:
            for key, value in recent.items():
                sums[key] = sums.get(key, 0.0) + value
        whole_s = sum(each for each, _ in self._recent)
        return {key: value / whole_s for key, value in sums.items() if key in totals}

    def _totals_of(self, graph: Graph) -> dict[str, float]:
        rates = self._rates
        rtts = [each.rtt_ms for each in graph.links.values() if each.rtt_ms is not None]
        return {
            "bytes_s": round(sum(rate for key, rate in rates.items() if key.startswith("link ")), 1),
            "messages_s": round(rates.get("messages_out", 0.0), 2),
            "drops_s": round(sum(rate for key, rate in rates.items() if key.startswith("drop ")), 2),
            "rtt_ms": round(max(rtts, default=0.0), 3),
        }

    def _samples(self, graph: Graph) -> dict[str, float]:
        totals = self._totals_of(graph)
        found = {
            "total bytes": totals["bytes_s"],
            "total messages": totals["messages_s"],
            "total drops": totals["drops_s"],
            "total rtt": totals["rtt_ms"],
        }
        for link in graph.links.values():
            key = _link_key(link)
            found[key] = self._rates.get(f"{key}>", 0.0) + self._rates.get(f"{key}<", 0.0)
            found[f"rtt {link.a} {link.b}"] = link.rtt_ms or 0.0
        for key, rate in self._rates.items():
            if key.startswith("name "):
                found[key] = rate
            elif key.startswith("drop "):
                node = " ".join(key.split(" ")[:2])
                found[node] = found.get(node, 0.0) + rate
        return found

    def _tell(self, what: str, text: str, *, about: str = "", is_bad: bool = False) -> None:
        self._event_number += 1
        self._events.append(
            {
                "number": self._event_number,
                "unix_s": round(self._unix_s, 3),
                "what": what,
                "text": text,
                "about": about,
                "is_bad": is_bad,
            }
        )

    def _tell_changes(self, graph: Graph) -> None:
        before = self.graph
        for node_id in graph.nodes.keys() - before.nodes.keys():
            self._tell("node", f"{_node_text(graph, node_id)} is up", about=node_id)
        for node_id in before.nodes.keys() - graph.nodes.keys():
            self._tell("node", f"{_node_text(before, node_id)} is gone", about=node_id, is_bad=True)
        for node_id in graph.nodes.keys() & before.nodes.keys():
            is_near = graph.nodes[node_id].is_near
            if is_near != before.nodes[node_id].is_near:
                # once it is silent, only others' link states name it, and they have no label
                text = f"{_node_text(graph if is_near else before, node_id)} "
                text += "answers again" if is_near else "no longer answers"
                self._tell("node", text, about=node_id, is_bad=not is_near)
        for a, b in graph.links.keys() - before.links.keys():
            self._tell("link", f"link {_node_text(graph, a)} – {_node_text(graph, b)} is up", about=a)
        for a, b in before.links.keys() - graph.links.keys():
            self._tell("link", f"link {_node_text(before, a)} – {_node_text(before, b)} is lost", about=a, is_bad=True)
        self._tell_names("is used", graph, graph.names.keys() - before.names.keys(), is_bad=False)
        self._tell_names("is no longer used", before, before.names.keys() - graph.names.keys(), is_bad=True)
        servers = {(each.name, each.server) for each in graph.replicas if each.is_there}
        known = {(each.name, each.server) for each in before.replicas if each.is_there}
        for name, server in servers - known:
            text = f"{_node_text(graph, server)} serves {_name_text(graph, name)}"
            self._tell("replica", text, about=name)
        for name, server in known - servers:
            text = f"{_node_text(before, server)} no longer serves {_name_text(before, name)}"
            self._tell("replica", text, about=name, is_bad=True)
        held, was_held = (
            {(each.id, at) for each in one.names.values() for at in each.holders} for one in (graph, before)
        )
        for name, holder in sorted(held - was_held):
            self._tell("control", f"{_node_text(graph, holder)} controls {_name_text(graph, name)}", about=name)
        for node_id, node in graph.nodes.items():
            then = before.nodes[node_id].waiting if node_id in before.nodes else ()
            for reason in set(node.waiting) - set(then):
                self._tell("wait", f"{_node_text(graph, node_id)} waits: {reason}", about=node_id, is_bad=True)

    def _tell_names(self, verb: str, graph: Graph, names: set[str], *, is_bad: bool) -> None:
        if len(names) > _LISTED_MAX:
            self._tell("name", f"{len(names)} names: each {verb}", is_bad=is_bad)
            return
        for name in sorted(names):
            self._tell("name", f"{_name_text(graph, name)} {verb}", about=name, is_bad=is_bad)

    def _tell_drops(self, now_s: float, graph: Graph) -> None:
        for (node, reason), count in graph.drops.items():
            rate = self._rates.get(f"drop {node} {reason}", 0.0)
            if rate and now_s - self._drop_events.get((node, reason), float("-inf")) >= _DROP_PAUSE_S:
                self._drop_events[node, reason] = now_s
                text = f"{_node_text(graph, node)} drops: {reason}, {count:g} so far"
                self._tell("drop", text, about=node, is_bad=True)

    def _tell_reports(self, graph: Graph) -> None:
        for each in graph.reports:
            at_s = number_of(each, "unix_s")
            if at_s > self._reports_seen:
                self._tell("cluster", text_of(each, "text"), about=text_of(each, "cluster"))
        self._reports_seen = max([self._reports_seen, *(number_of(each, "unix_s") for each in graph.reports)])


def _structure_of(graph: Graph) -> dict[str, object]:
    index = {node: at for at, node in enumerate(graph.nodes)}
    return {
        "domains": sorted(([domain, label] for domain, label in graph.domains.items()), key=lambda row: row[::-1]),
        "nodes": [[each.id, each.role, each.label, each.domain, each.is_near] for each in graph.nodes.values()],
        "links": [
            [index[each.a], index[each.b], each.cost, each.mtu, sorted(each.ports)] for each in graph.links.values()
        ],
        "names": [_name_row(each, index) for each in graph.names.values()],
        "clusters": [dict(each) for each in graph.clusters],
        "left_out": graph.left_out,
    }


def _name_row(entry: NameEntry, index: Mapping[str, int]) -> list[object]:
    ends = (entry.publishers, entry.readers, entry.servers, entry.clients, *([entry.holders] if entry.holders else ()))
    return [
        entry.id, entry.label, entry.kind, entry.type,
        *(sorted(index[each] for each in end if each in index) for end in ends),
    ]  # fmt: skip


def _link_key(link: Link) -> str:
    return f"link {link.a} {link.b}"


def _node_text(graph: Graph, node_id: str) -> str:
    node = graph.nodes.get(node_id)
    if node is None:
        return f"node {node_id[:6]}"
    label = node.label or node_id[:6]
    return label if label.startswith(node.role) else f"{node.role} {label}"


def _name_text(graph: Graph, name_id: str) -> str:
    name = graph.names.get(name_id)
    return name_id[:6] if name is None or not name.label else name.label
