"""Shortest paths over what the link states say, and only through domains that are allowed.

Place: pure.
Source: Dijkstra, by networkx. Edges are directed; a link counts when both ends name it. Of another domain a switch sees
the borders only, so the way to a switch behind them is the way to the nearest border.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from gdp.control.link_state import LinkState, Scope
from gdp.names import Name
from gdp.switch.link_states import LinkStates

if TYPE_CHECKING:
    import networkx as nx

__all__ = ["Paths", "Way"]

_CACHE_MAX = 64


class Way(NamedTuple):
    """The way to a target."""

    first: Name  # the neighbour to go through
    distance: int


class Paths:
    """Answers of shortest-path questions, computed when first asked after a change."""

    def __init__(self, me: Name, domain: Name, link_states: LinkStates) -> None:
        self._me = me
        self._domain = domain
        self._link_states = link_states
        self._version = -1
        self._graph: nx.DiGraph[Name] | None = None
        self._domains: dict[Name, Name] = {}
        self._ribs: dict[Name, set[Name]] = {}
        self._ways: dict[frozenset[Name], dict[Name, Way]] = {}

    def to_switch(self, switch: Name, domain: Name, allowed: frozenset[Name]) -> Way | None:
        """Return the way to a switch of a domain; None when there is none through ``allowed`` domains."""
        ways = self._to_all(allowed)
        if domain == self._domain or switch in ways:
            return ways.get(switch)
        borders = (ways[each] for each, its in self._domains.items() if its == domain and each in ways)
        return min(borders, key=lambda way: way.distance, default=None)

    def to_rib(self, rib: Name, allowed: frozenset[Name]) -> tuple[Way | None, Name | None]:
        """Return the way to the nearest switch from which a RIB is reached, and that switch (self: no way needed).

        Args:
            allowed: domains to pass through; the one that the RIB stands in may be another.
        """
        self._refresh()
        hosts = self._ribs.get(rib, set())
        if self._me in hosts:
            return None, self._me
        found = ((self.to_switch(host, self._domains[host], allowed | {self._domains[host]}), host) for host in hosts)
        reachable = [(way, host) for way, host in found if way is not None]
        return min(reachable, key=lambda each: each[0].distance, default=(None, None))

    def is_switch(self, name: Name) -> bool:
        """Return whether a link state names this switch."""
        self._refresh()
        return name in self._domains

    def is_rib(self, name: Name) -> bool:
        """Return whether a link state names this RIB."""
        self._refresh()
        return name in self._ribs

    def domain_of(self, switch: Name) -> Name | None:
        """Return a known switch's domain."""
        self._refresh()
        return self._domains.get(switch)

    def ribs(self) -> frozenset[Name]:
        """Return the RIBs of our own domain that are attached somewhere."""
        return frozenset(rib for state in self._link_states.states(Scope.DOMAIN) for rib in state.ribs)

    def borders(self) -> dict[Name, int]:
        """Return the other switches of our domain that have links leaving it, with their distance within it."""
        ways = self._to_all(frozenset({self._domain}))
        states = self._link_states.states(Scope.DOMAIN)
        borders = {s.origin for s in states if any(link.domain != self._domain for link in s.links)}
        return {border: ways[border].distance for border in sorted(borders) if border in ways}

    def _to_all(self, allowed: frozenset[Name]) -> dict[Name, Way]:
        self._refresh()
        ways = self._ways.get(allowed)
        if ways is None:
            if len(self._ways) >= _CACHE_MAX:
                self._ways.clear()
            ways = self._ways[allowed] = self._compute(allowed)
        return ways

    def _compute(self, allowed: frozenset[Name]) -> dict[Name, Way]:
        if self._graph is None or self._me not in self._graph:
            return {}
        from networkx import dijkstra_predecessor_and_distance

        open_ = {name for name, domain in self._domains.items() if domain in allowed or domain == self._domain}

        def cost(_from: Name, to: Name, edge: dict[str, int]) -> int | None:
            return edge["weight"] if to in open_ else None  # None hides an edge

        before, distances = dijkstra_predecessor_and_distance(self._graph, self._me, weight=cost)
        ways: dict[Name, Way] = {}
        for to, distance in distances.items():  # the nearest first: whoever comes before ``to`` is there already
            if to != self._me:
                last = before[to][0]
                ways[to] = Way(to if last == self._me else ways[last].first, int(distance))
        return ways

    def _refresh(self) -> None:
        if self._version == self._link_states.version:
            return
        self._version = self._link_states.version
        self._ways.clear()
        home = self._link_states.states(Scope.DOMAIN)
        borders = self._link_states.states(Scope.BORDER)
        self._domains = {state.origin: state.domain for state in [*home, *borders]}
        self._ribs = {}
        for state in [*home, *(each for each in borders if each.domain != self._domain)]:
            for rib in state.ribs:
                self._ribs.setdefault(rib, set()).add(state.origin)
        self._graph = _graph([*home, *borders], self._domain)


def _graph(states: Iterable[LinkState], home: Name) -> nx.DiGraph[Name]:
    """Return the links; of other domains also the ways between their borders, which hide what lies inside."""
    cost: dict[tuple[Name, Name], int] = {}
    for state in states:
        for link in state.links if state.domain == home else [*state.links, *state.inside]:
            edge = (state.origin, link.name)
            cost[edge] = min(cost.get(edge, link.cost), link.cost)
    from networkx import DiGraph  # large; nothing is asked before there is a neighbour

    graph: nx.DiGraph[Name] = DiGraph()
    # sorted: among ways of one length every switch picks by the same order
    graph.add_weighted_edges_from((a, b, cost[a, b]) for a, b in sorted(cost) if (b, a) in cost)
    return graph
