"""Shortest paths from one node of a directed graph to all others.

Sans-I/O. Source: E. W. Dijkstra, "A note on two problems in connexion with graphs", Numerische Mathematik 1 (1959).
Among paths of one length the one that is found first counts, so the order of the edges decides.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Mapping
from itertools import count
from typing import TypeVar

N = TypeVar("N", bound=Hashable)


def add_edge(graph: dict[N, dict[N, int]], start: N, end: N, cost: int) -> None:
    """Add an edge, and its ends where they are not there yet."""
    graph.setdefault(start, {})[end] = cost
    graph.setdefault(end, {})


def shortest_paths(
    graph: Mapping[N, Mapping[N, int]], start: N, is_open: Callable[[N, N], bool] = lambda _start, _end: True
) -> tuple[dict[N, N], dict[N, int]]:
    """Return the node before each node that is reached, and the distance of each, the nearest first.

    Args:
        graph: each node with the costs of the edges out of it, none below 0.
        start: a node of the graph; no node is before it.
        is_open: returns whether the edge between two nodes may be used.
    """
    before: dict[N, N] = {}
    found: dict[N, int] = {start: 0}
    distances: dict[N, int] = {}
    order = count()
    waiting = [(0, next(order), start)]
    while waiting:
        distance, _, here = heapq.heappop(waiting)
        if here in distances:
            continue
        distances[here] = distance
        for to, cost in graph[here].items():
            if to not in distances and is_open(here, to) and (to not in found or distance + cost < found[to]):
                found[to] = distance + cost
                before[to] = here
                heapq.heappush(waiting, (found[to], next(order), to))
    return before, distances
