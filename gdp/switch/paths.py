"""Shortest paths over the link states, restricted to the domains that are allowed.

Sans-I/O. Edges are directed; a link counts when both ends list it. Of another domain a
switch sees only the borders. So the path to a switch behind them is the path to the nearest border that lists it. A
part of the own domain that a failure has cut off is reached in the same way: through its borders, over other domains.

A leaf is an end and never transit: no edge leads out of it, except for itself (RFC 6987; the overload bit of IS-IS, RFC
3277). That follows from the certificate in its link state, whatever costs it lists. Switches that only leaves connect
to this one are ``severed``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from gdp.control.link_state import Adjacency, AttachedRib, LinkState, Scope
from gdp.names import ZERO, Name
from gdp.shortest_paths import add_edge, shortest_paths
from gdp.switch.disjoint import DirectedLink, DirectedPath, disjoint_paths
from gdp.switch.lsdb import LinkStateDatabase

_CACHE_MAX = 64
_ALTERNATES_CACHE_MAX = 4_096
_PAIRS_CACHE_MAX = 1_024
_ALTERNATES_SWITCHES_MAX = 256  # above this, paths from every neighbour would keep a switch busy for too long


class Path(NamedTuple):
    """The path to a target."""

    first: Name  # the neighbour that is the next hop
    distance: int
    alternate: Name | None = None  # another neighbour, from which frames do not return


class Paths:
    """Shortest paths, computed at the first request after a change.

    Attributes:
        link_states: that the paths follow from.
        has_alternates: whether paths include their loop-free alternates (RFC 5286). Alternates cost a computation for
            each neighbour, so that no urgent work may wait for them.
    """

    def __init__(self, me: Name, domain: Name, link_states: LinkStateDatabase) -> None:
        self._me = me
        self._domain = domain
        self.link_states = link_states
        self._version = -1
        self._graph: dict[Name, dict[Name, int]] = {}
        self._members: frozenset[Name] = frozenset()  # switches of our domain that are reachable within it
        self._leaves: frozenset[Name] = frozenset()  # of our domain
        self._severed: frozenset[Name] = frozenset()  # of our domain
        self._is_border_severed = False
        self._domains: dict[Name, Name] = {}  # of every switch that is known by name
        # Borders that list a switch that is not in the graph, by that switch and its domain.
        self._borders_of: dict[tuple[Name, Name], list[Name]] = {}
        self._beyond: dict[Name, list[Name]] = {}  # by domain: borders that are reached over links between domains
        self._open_borders: dict[Name, list[Name]] = {}  # by domain: borders that could not list all their switches
        self._ribs: dict[Name, dict[Name, AttachedRib]] = {}  # RIB to the switches where it is attached or reached
        self._known_domains: frozenset[Name] = frozenset()
        self._incarnation_ids: dict[Name, bytes] = {}  # of every switch whose link state is known
        self._refused: frozenset[Name] = frozenset()
        self._ways: dict[tuple[Name, frozenset[Name]], dict[Name, Path]] = {}
        self._alternates: dict[tuple[Name, Name, frozenset[Name]], Name | None] = {}
        self._links: dict[DirectedLink, int] = {}  # cost of each link, parallel ones apart, of us and other domains
        self._pairs: dict[tuple[Name, Name], tuple[DirectedPath, ...]] = {}
        self.has_alternates = False

    def to_switch(self, switch: Name, domain: Name, allowed: frozenset[Name]) -> Path | None:
        """Return the path to a switch of a domain; None when there is none through ``allowed`` domains.

        A path within our own domain goes first (RFC 2328, 16.2). Switches outside know only the distance to our
        borders, and would send back what left our domain in order to enter it elsewhere.
        """
        self._refresh()
        if switch in self._members:
            allowed = frozenset({self._domain})
        way = self._pick(self._to_all(allowed), switch, domain)
        if way is None or not self.has_alternates:
            return way
        key = switch, domain, allowed & self._known_domains
        if key not in self._alternates:
            if len(self._alternates) >= _ALTERNATES_CACHE_MAX:
                self._alternates.clear()
            self._alternates[key] = self._alternate(way, switch, domain, allowed)
        return way._replace(alternate=self._alternates[key])

    def _alternate(self, path: Path, switch: Name, domain: Name, allowed: frozenset[Name]) -> Name | None:
        """Return the best neighbour whose own shortest path does not lead back here: RFC 5286, inequality 1.

        Only a neighbour of our domain qualifies, because the path choice of other domains is unknown. A leaf is none.
        For a leaf each neighbour that has a path is one, since no frame returns through a leaf.
        """
        if len(self._graph) > _ALTERNATES_SWITCHES_MAX:
            return None
        found: list[tuple[int, Name]] = []
        for neighbour, cost in self._graph[self._me].items():
            if neighbour == path.first or self._domains.get(neighbour) != self._domain:
                continue
            if neighbour in self._leaves and neighbour != switch:
                continue
            onwards = self._distance(neighbour, switch, domain, allowed)
            back = self._distance(neighbour, self._me, self._domain, allowed)
            if onwards is None or back is None:
                continue
            if self._me in self._leaves or onwards < back + path.distance:
                found.append((cost + onwards, neighbour))
        return min(found, default=(0, None))[1]

    def is_only_way(self, neighbour: Name) -> bool:
        """Return whether the link between them alone joins this switch and a neighbour, as far as is known."""
        self._refresh()
        if self._me not in self._graph or neighbour not in self._graph:
            return True  # a switch that has just started knows others before its own first link is in the graph
        link = self._me, neighbour
        _, others = shortest_paths(self._graph, self._me, lambda start, end: (start, end) != link)
        return neighbour not in others

    def distance_from(self, start: Name, switch: Name, domain: Name, allowed: frozenset[Name]) -> int | None:
        """Return the distance of a switch from another one than this; None where there is no path."""
        self._refresh()
        if start in self._leaves and start != switch:
            return None
        within = switch in self._members and start in self._members
        return self._distance(start, switch, domain, frozenset({self._domain}) if within else allowed)

    def _distance(self, start: Name, switch: Name, domain: Name, allowed: frozenset[Name]) -> int | None:
        way = self._pick(self._to_all(allowed, start), switch, domain)
        return 0 if start == switch else None if way is None else way.distance

    def _pick(self, ways: dict[Name, Path], switch: Name, domain: Name) -> Path | None:
        if switch in ways:
            return ways[switch]
        borders = self._borders_of.get((switch, domain)) or self._fallback_borders(domain)
        return min((ways[each] for each in borders if each in ways), key=lambda way: way.distance, default=None)

    def _fallback_borders(self, domain: Name) -> list[Name]:
        """Return the borders to try for an unlisted switch: it may be new, or beyond a border's list limit."""
        if domain == self._domain:
            return self._open_borders.get(domain, [])
        return self._beyond.get(domain, [])

    def to_rib(self, rib: Name, allowed: frozenset[Name]) -> tuple[Path | None, Name | None]:
        """Return the path to the nearest switch that reaches a RIB, and that switch (self: no path needed).

        Args:
            allowed: domains to pass through; the RIB's own domain may be another.
        """
        self._refresh()
        hosts = self._ribs.get(rib, {})
        if self._me in hosts:
            return None, self._me
        found = ((self.to_switch(host, self._domains[host], allowed | {self._domains[host]}), host) for host in hosts)
        reachable = [(way, host) for way, host in found if way is not None]
        return min(reachable, key=lambda each: each[0].distance, default=(None, None))

    def incarnation_elsewhere(self, name: Name) -> bytes | None:
        """Return the mark of the oldest incarnation in which other switches reach a switch or a RIB, or None."""
        if self.is_switch(name):
            hosts = {} if (incarnation_id := self._incarnation_ids.get(name)) is None else {name: incarnation_id}
        else:
            hosts = {host: rib.incarnation_id for host, rib in self._ribs.get(name, {}).items() if host != self._me}
        if not hosts:
            return None  # a proxy, for example: its hellos cause no computation
        everywhere = frozenset(self._domains.values())
        incarnation_ids = [incarnation_id for host, incarnation_id in hosts.items() if host in self._to_all(everywhere)]
        return min(incarnation_ids, default=None)

    def refused_elsewhere(self) -> frozenset[Name]:
        """Return the identities that other switches refuse at present because an older node has them."""
        self._refresh()
        return self._refused

    def is_switch(self, name: Name) -> bool:
        """Return whether a link state lists this switch."""
        self._refresh()
        return name in self._domains

    def is_rib(self, name: Name) -> bool:
        """Return whether a link state lists this RIB."""
        self._refresh()
        return name in self._ribs

    def domain_of(self, switch: Name) -> Name | None:
        """Return a known switch's domain."""
        self._refresh()
        return self._domains.get(switch)

    def ribs(self) -> dict[Name, AttachedRib]:
        """Return every RIB that a link state lists, our own domain's and others', by name."""
        self._refresh()
        return {rib: min(hosts.values()) for rib, hosts in self._ribs.items()}

    def ribs_inside(self) -> frozenset[AttachedRib]:
        """Return the RIBs that are attached to switches of our domain that are reachable within it."""
        self._refresh()
        hosts = (state for state in self.link_states.states(Scope.DOMAIN) if state.origin in self._members)
        return frozenset(rib for state in hosts for rib in state.ribs)

    def members(self) -> frozenset[Name]:
        """Return the switches of our domain that are reachable within it, this one too."""
        self._refresh()
        return self._members

    def severed(self) -> frozenset[Name]:
        """Return the switches of our domain that only leaves connect to this one: no path leads to them."""
        self._refresh()
        return self._severed

    def leads_through_leaf(self, switch: Name, domain: Name) -> bool:
        """Return whether an unreachable switch might be reachable if leaves carried transit."""
        self._refresh()
        return switch in self._severed if domain == self._domain else self._is_border_severed

    def borders(self) -> dict[Name, int]:
        """Return the other switches of our domain that have links leaving it, with their distance within it."""
        ways = self._to_all(frozenset({self._domain}))
        states = self.link_states.states(Scope.DOMAIN)
        borders = {s.origin for s in states if any(link.domain != self._domain for link in s.links)}
        return {each: ways[each].distance for each in sorted(borders & self._members) if each in ways}

    def cost_of(self, path: DirectedPath) -> int | None:
        """Return the cost of a path; None where one of its links is gone."""
        self._refresh()
        costs = [self._links.get(link) for link in path]
        return None if None in costs else sum(cost for cost in costs if cost is not None)

    def disjoint(self, switch: Name, domain: Name) -> tuple[DirectedPath, ...]:
        """Return two paths to a switch that share as few links as possible; one or none, as ``disjoint_paths``.

        To a switch of another domain they end at its borders, over links of our own domain and one link that leaves it.
        """
        self._refresh()
        key = switch, domain
        if key not in self._pairs:
            if len(self._pairs) >= _PAIRS_CACHE_MAX:
                self._pairs.clear()
            self._pairs[key] = self._disjoint(switch, domain)
        return self._pairs[key]

    def _disjoint(self, switch: Name, domain: Name) -> tuple[DirectedPath, ...]:
        ends = self._leaves - {self._me}
        within = switch in self._members
        borders = () if within else self._borders_to(switch, domain)
        costs: dict[DirectedLink, int] = {}
        for link, cost in self._links.items():
            if link.start in ends or link.start not in self._members:
                continue
            if link.end in self._members or link.end in borders:
                costs[link] = cost
        for border in borders:
            costs[DirectedLink(border, ZERO, 0)] = 1
        found = disjoint_paths(costs, self._me, switch if within else ZERO)
        return found if within else tuple(dict.fromkeys(path[:-1] for path in found))

    def _borders_to(self, switch: Name, domain: Name) -> frozenset[Name]:
        """Return the borders of another domain behind which a switch is."""
        if domain == self._domain:
            return frozenset()  # a part of our own domain that is cut off
        listed = self._borders_of.get((switch, domain)) or self._fallback_borders(domain)
        return frozenset([*listed, *([switch] if switch in self._domains else [])])

    def _to_all(self, allowed: frozenset[Name], start: Name | None = None) -> dict[Name, Path]:
        """Return the paths from a switch, this one if not given, to all others."""
        self._refresh()
        # an unknown sender's list may hold other domains, different ones each time
        key = start or self._me, allowed & self._known_domains
        ways = self._ways.pop(key, None)
        if ways is None:
            ways = self._compute(*key)
            if len(self._ways) >= _CACHE_MAX:
                del self._ways[next(iter(self._ways))]  # the least recently used
        self._ways[key] = ways
        return ways

    def _compute(self, start: Name, allowed: frozenset[Name]) -> dict[Name, Path]:
        if start not in self._graph:
            return {}
        open_ = {name for name, domain in self._domains.items() if domain in allowed or domain == self._domain}
        ends = self._leaves - {start}

        before, distances = shortest_paths(self._graph, start, lambda from_, to: to in open_ and from_ not in ends)
        ways: dict[Name, Path] = {}
        for to, distance in distances.items():  # nearest first: the hop before ``to`` is already there
            if to != start:
                last = before[to]
                ways[to] = Path(to if last == start else ways[last].first, distance)
        return ways

    def _refresh(self) -> None:
        if self._version == self.link_states.version:
            return
        self._version = self.link_states.version
        self._ways.clear()
        self._alternates.clear()
        self._pairs.clear()
        home = self.link_states.states(Scope.DOMAIN)
        self._leaves = frozenset(state.origin for state in home if state.is_leaf)
        self._members = _reachable(self._me, home, self._domain, self._leaves)
        joined = _reachable(self._me, home, self._domain) if self._leaves else self._members
        self._severed = joined - self._members
        self._is_border_severed = any(
            state.origin in self._severed and any(link.domain != self._domain for link in state.links) for state in home
        )
        inside = [state for state in home if state.origin in self._members]
        beyond = [state for state in self.link_states.states(Scope.BORDER) if state.origin not in self._members]
        self._domains = {member: state.domain for state in beyond for member in state.members}
        self._domains |= {state.origin: state.domain for state in [*home, *beyond]}
        self._known_domains = frozenset(self._domains.values())
        self._borders_of, self._open_borders, self._beyond, self._ribs = {}, {}, {}, {}
        others = [state for state in [*inside, *beyond] if state.origin != self._me]
        self._incarnation_ids = {state.origin: state.incarnation_id for state in others}
        self._refused = frozenset(name for state in others for name in state.refused)
        for state in beyond:
            self._beyond.setdefault(state.domain, []).append(state.origin)
            for member in state.members:
                self._borders_of.setdefault((member, state.domain), []).append(state.origin)
            if state.is_partial:
                self._open_borders.setdefault(state.domain, []).append(state.origin)
        for state in [*inside, *beyond]:
            for rib in state.ribs:
                self._ribs.setdefault(rib.name, {})[state.origin] = rib
        self._links = _links([(s.origin, s.links) for s in [*inside, *beyond]])
        self._graph = _graph([(s.origin, s.links) for s in inside] + [(s.origin, s.links + s.inside) for s in beyond])


def _reachable(
    me: Name, states: Iterable[LinkState], domain: Name, leaves: frozenset[Name] = frozenset()
) -> frozenset[Name]:
    """Return the switches that are joined to ``me`` by links within the domain, and not through these leaves."""
    links = {state.origin: {link.name for link in state.links if link.domain == domain} for state in states}
    found, todo = {me}, [me]
    while todo:
        here = todo.pop()
        joined = {each for each in links.get(here, ()) if here in links.get(each, ())} - found
        found |= joined
        todo += joined - leaves
    return frozenset(found)


def _links(edges: Iterable[tuple[Name, tuple[Adjacency, ...]]]) -> dict[DirectedLink, int]:
    """Return the cost of each link that both ends list with one key."""
    costs: dict[DirectedLink, int] = {}
    for origin, links in edges:
        for link in links:
            each = DirectedLink(origin, link.name, link.key)
            costs[each] = min(costs.get(each, link.cost), link.cost)
    return {each: costs[each] for each in sorted(costs) if DirectedLink(each.end, each.start, each.key) in costs}


def _graph(edges: Iterable[tuple[Name, tuple[Adjacency, ...]]]) -> dict[Name, dict[Name, int]]:
    """Return the graph of all links that both ends list."""
    cost: dict[tuple[Name, Name], int] = {}
    for origin, links in edges:
        for link in links:
            edge = (origin, link.name)
            cost[edge] = min(cost.get(edge, link.cost), link.cost)
    graph: dict[Name, dict[Name, int]] = {}
    for a, b in sorted(cost):  # among ways of one length every switch picks in the same order
        if (b, a) in cost:
            add_edge(graph, a, b, cost[a, b])
    return graph
