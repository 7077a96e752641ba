"""Two paths of least total cost that share as few links as possible.

Sans-I/O. Source: Suurballe and Tarjan, "A quick method for finding shortest pairs of disjoint paths", Networks 14
(1984); a shared link has a cost above that of all paths, as in Bhandari, "Survivable Networks" (1999). Two switches may
be joined by several links, one for each uplink, so a link has a key. ``docs/explanation/two-paths.md`` is the design of
what uses it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple, TypeAlias

from gdp.names import Name
from gdp.shortest_paths import add_edge, shortest_paths


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
_Graph: TypeAlias = "dict[_Node, dict[_Node, int]]"


def disjoint_paths(links: Mapping[DirectedLink, int], source: Name, target: Name) -> tuple[DirectedPath, ...]:
    """Return two paths, the cheaper one first; one path if there is no other, and none if there is no path.

    Of all pairs, those with the fewest shared links count, and of these the one of least total cost. A pair shares a
    link only where every path needs it. It takes two runs of Dijkstra's algorithm.

    Args:
        links: the cost of each, above 0.
    """
    costs = {link: links[link] for link in _by_start(links)}
    graph = _with_links(costs)
    if source not in graph or target not in graph or source == target:
        return ()
    before, distances = shortest_paths(graph, source)
    if target not in distances:
        return ()
    first = [each for each in _passed(before, source, target) if isinstance(each, DirectedLink)]
    residual = _residual(costs, distances, first)
    second = _passed(shortest_paths(residual, source)[0], source, target)
    used = _used_links(first, second)
    paths = [_take_path(used, source, target) for _ in range(2)]
    if paths[0] == paths[1]:
        return (paths[0],)
    return tuple(sorted(paths, key=lambda path: (sum(costs[link] for link in path), path)))


def _by_start(links: Iterable[DirectedLink]) -> list[DirectedLink]:
    """Return the links out of each switch together, in the order in which a link first names the switch."""
    out: dict[Name, list[DirectedLink]] = {}
    for link in links:
        out.setdefault(link.start, []).append(link)
        out.setdefault(link.end, [])
    return [link for each in out.values() for link in each]


def _passed(before: Mapping[_Node, _Node], source: Name, target: Name) -> list[_Node]:
    """Return the nodes of a path before its target, the last one first."""
    passed: list[_Node] = []
    node: _Node = target
    while node != source:
        node = before[node]
        passed.append(node)
    return passed


def _with_links(costs: Mapping[DirectedLink, int]) -> _Graph:
    """Return a graph in which each link is a node between its ends."""
    graph: _Graph = {}
    for link, cost in costs.items():
        add_edge(graph, link.start, link, cost)
        add_edge(graph, link, link.end, 0)
    return graph


def _residual(costs: Mapping[DirectedLink, int], distances: Mapping[_Node, int], first: list[DirectedLink]) -> _Graph:
    """Return the graph of the second run: reduced costs, and the links of the first path reversed or shared."""
    on_first, shared_cost = set(first), 1 + sum(costs.values())
    graph: _Graph = {}
    for link, cost in costs.items():
        if link.start not in distances:
            continue
        if link in on_first:
            add_edge(graph, link.end, link, 0)
            add_edge(graph, link, link.start, 0)
            add_edge(graph, link.start, _Shared(link), shared_cost)
            add_edge(graph, _Shared(link), link.end, 0)
        else:
            add_edge(graph, link.start, link, cost + distances[link.start] - distances[link.end])
            add_edge(graph, link, link.end, 0)
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
