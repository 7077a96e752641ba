"""Shortest paths of a graph: compared with those of networkx on drawn graphs, also among paths of one length."""

from __future__ import annotations

import networkx as nx
from hypothesis import given
from hypothesis import strategies as st

from gdp.shortest_paths import add_edge, shortest_paths

NODES = st.integers(0, 7)
EDGES = st.lists(st.tuples(NODES, NODES, st.integers(0, 4)), max_size=30)


@given(EDGES, st.sets(st.tuples(NODES, NODES), max_size=4))
def test_paths_are_those_of_networkx(edges: list[tuple[int, int, int]], hidden: set[tuple[int, int]]) -> None:
    graph: dict[int, dict[int, int]] = {0: {}}
    other: nx.DiGraph[int] = nx.DiGraph()
    other.add_node(0)
    for start, end, cost in edges:
        add_edge(graph, start, end, cost)
        other.add_edge(start, end, weight=cost)
    before, distances = shortest_paths(graph, 0, lambda start, end: (start, end) not in hidden)
    wanted, far = nx.dijkstra_predecessor_and_distance(
        other, 0, weight=lambda start, end, edge: None if (start, end) in hidden else edge["weight"]
    )
    assert [*distances.items()] == [*far.items()]
    assert before == {node: others[0] for node, others in wanted.items() if node}
