"""Two paths of least total cost that share as few links as possible.

Sans-I/O. Source: Suurballe and Tarjan, "A quick method for finding shortest pairs of disjoint paths", Networks 14
(1984); a shared link has a cost above that of all paths, as in Bhandari, "Survivable Networks" (1999). Two switches may
be joined by several links, one for each uplink, so a link has a key. ``docs/explanation/two-paths.md`` is the design of
what uses it.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

from gdp.names import Name

if TYPE_CHECKING:
    import networkx as nx

__all__ = ["DirectedLink", "DirectedPath", "disjoint_paths"]

_WEIGHT: Final = "weight"


class DirectedLink(NamedTuple):
    """A link in one direction; ``key`` tells links between the same two switches apart."""

    start: Name
    end: Name
    key: int


class _Shared(NamedTuple):
    """Second use of a link, where nothing else leads on."""

    link: DirectedLink


_Node = Name | DirectedLink | _Shared
DirectedPath = tuple[DirectedLink, ...]


def disjoint_paths(graph: nx.MultiDiGraph[Name], source: Name, target: Name) -> tuple[DirectedPath, ...]:
    """Return two paths, the cheaper one first; one path if there is no other, and none if there is no path.

    Of all pairs, those with the fewest shared links count, and of these the one of least total cost. A pair shares a
    link only where every path needs it. It takes two runs of Dijkstra's algorithm.

    Args:
        graph: each edge has a ``weight`` above 0.
    """
    from networkx import dijkstra_path, dijkstra_predecessor_and_distance

    if source not in graph or target not in graph or source == target:
        return ()
    edges = graph.edges(keys=True)
    costs = {DirectedLink(*edge): int(graph.edges[edge][_WEIGHT]) for edge in edges}
    before, distances = dijkstra_predecessor_and_distance(_with_links(costs), source)
    if target not in distances:
        return ()
    first: list[DirectedLink] = []
    node: _Node = target
    while node != source:
        node = before[node][0]
        if isinstance(node, DirectedLink):
            first.append(node)
    second = dijkstra_path(
        _residual(costs, {each: int(distance) for each, distance in distances.items()}, first), source, target
    )
    used = _used_links(first, second)
    paths = [_take_path(used, source, target) for _ in range(2)]
    if paths[0] == paths[1]:
        return (paths[0],)
    return tuple(sorted(paths, key=lambda path: (sum(costs[link] for link in path), path)))


def _with_links(costs: dict[DirectedLink, int]) -> nx.DiGraph[_Node]:
    """Return a graph in which each link is a node between its ends."""
    from networkx import DiGraph

    graph: nx.DiGraph[_Node] = DiGraph()
    for link, cost in costs.items():
        graph.add_edge(link.start, link, weight=cost)
        graph.add_edge(link, link.end, weight=0)
    return graph


def _residual(
    costs: dict[DirectedLink, int], distances: dict[_Node, int], first: list[DirectedLink]
) -> nx.DiGraph[_Node]:
    """Return the graph of the second run: reduced costs, and the links of the first path reversed or shared."""
    from networkx import DiGraph

    on_first, shared_cost = set(first), 1 + sum(costs.values())
    graph: nx.DiGraph[_Node] = DiGraph()
    for link, cost in costs.items():
        if link.start not in distances:
            continue
        if link in on_first:
            graph.add_edge(link.end, link, weight=0)
            graph.add_edge(link, link.start, weight=0)
            graph.add_edge(link.start, _Shared(link), weight=shared_cost)
            graph.add_edge(_Shared(link), link.end, weight=0)
        else:
            graph.add_edge(link.start, link, weight=cost + distances[link.start] - distances[link.end])
            graph.add_edge(link, link.end, weight=0)
    return graph


def _used_links(first: list[DirectedLink], second: list[_Node]) -> Counter[DirectedLink]:
    """Return how often each link is used; what the second run took backwards, neither path uses."""
    used = Counter(first)
    for node in second:
        if isinstance(node, _Shared):
            used[node.link] += 1
        elif isinstance(node, DirectedLink):
            used[node] += -1 if node in first else 1
    return +used


def _take_path(used: Counter[DirectedLink], source: Name, target: Name) -> DirectedPath:
    """Return one path over used links, in their order, and take it off them."""
    path: list[DirectedLink] = []
    here = source
    while here != target:
        link = min(each for each, count in used.items() if count and each.start == here)
        used[link] -= 1
        path.append(link)
        here = link.end
    return tuple(path)
