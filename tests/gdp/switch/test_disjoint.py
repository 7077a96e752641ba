"""Two disjoint paths: compared with the flow of least cost, and on drawn networks."""

from __future__ import annotations

from collections import Counter

import networkx as nx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.names import Name
from gdp.switch.disjoint import DirectedLink, disjoint_paths

NODES = tuple(Name(bytes([number]) * 32) for number in range(1, 7))
A, B, C, D, E, F = NODES
EDGES = st.lists(st.tuples(st.sampled_from(NODES), st.sampled_from(NODES), st.integers(1, 20)), max_size=24)
Edges = list[tuple[Name, Name, int]]


def links_of(edges: Edges) -> dict[DirectedLink, int]:
    """Return links in both directions, keyed by their place in the list."""
    links: dict[DirectedLink, int] = {}
    for key, (one, other, cost) in enumerate(edges):
        if one != other:
            links[DirectedLink(one, other, key)] = links[DirectedLink(other, one, key)] = cost
    return links


def total(edges: Edges, paths: tuple[tuple[DirectedLink, ...], ...]) -> tuple[int, int]:
    """Return the number of shared links and the cost of a pair; one path counts as two equal ones."""
    links = Counter(link for path in (paths * 2)[:2] for link in path)
    return sum(count - 1 for count in links.values()), sum(edges[link.key][2] * n for link, n in links.items())


def least_total(edges: Edges) -> tuple[int, int] | None:
    """Return the same of the flow of two units at least cost, by networkx; None if there is no path."""
    shared = 1 + 2 * sum(cost for _, _, cost in edges)
    flow: nx.DiGraph[object] = nx.DiGraph()
    flow.add_nodes_from(NODES)
    for key, (one, other, cost) in enumerate(edges):
        for start, end in ((one, other), (other, one)):
            for copy, weight in enumerate((cost, cost + shared)):
                flow.add_edge(start, (start, key, copy), capacity=1, weight=weight)
                flow.add_edge((start, key, copy), end, capacity=1, weight=0)
    flow.nodes[A]["demand"], flow.nodes[F]["demand"] = -2, 2
    try:
        cost = int(nx.min_cost_flow_cost(flow))
    except nx.NetworkXUnfeasible:
        return None
    return cost // shared, cost % shared


@given(EDGES)
def test_a_pair_shares_the_fewest_links_and_costs_the_least_of_all(edges: Edges) -> None:
    edges = [each for each in edges if each[0] != each[1]]
    paths = disjoint_paths(links_of(edges), A, F)
    assert (total(edges, paths) if paths else None) == least_total(edges)


@given(EDGES)
def test_each_path_leads_from_the_source_to_the_target_without_a_loop(edges: Edges) -> None:
    for path in disjoint_paths(links_of(edges), A, F):
        places = [A, *(link.end for link in path)]
        assert places[:-1] == [link.start for link in path]
        assert places[-1] == F
        assert len(set(places)) == len(places)


@given(EDGES)
def test_no_link_is_used_in_both_directions(edges: Edges) -> None:
    paths = disjoint_paths(links_of(edges), A, F)
    ways = {(link.key, link.start) for path in paths for link in path}
    assert len({key for key, _ in ways}) == len(ways)


def test_the_pair_may_avoid_the_shortest_path() -> None:
    edges = [(A, B, 1), (B, C, 1), (C, F, 1), (A, C, 4), (B, F, 4)]  # A-B-C-F alone blocks every other path
    paths = disjoint_paths(links_of(edges), A, F)
    assert [[link.key for link in path] for path in paths] in ([[0, 4], [3, 2]], [[3, 2], [0, 4]])


def test_two_uplinks_between_the_same_switches_are_two_paths() -> None:
    paths = disjoint_paths(links_of([(A, F, 30), (A, F, 80)]), A, F)
    assert [[link.key for link in path] for path in paths] == [[0], [1]]


def test_a_link_that_every_path_needs_is_shared_and_the_others_are_not() -> None:
    paths = disjoint_paths(links_of([(A, B, 30), (A, B, 80), (B, F, 10)]), A, F)
    assert [[link.key for link in path] for path in paths] == [[0, 2], [1, 2]]


def test_without_a_second_path_there_is_one() -> None:
    assert [[link.key for link in path] for path in disjoint_paths(links_of([(A, B, 1), (B, F, 1)]), A, F)] == [[0, 1]]


@pytest.mark.parametrize(("source", "target"), [(A, A), (A, D), (A, F), (F, A)])
def test_without_any_path_there_is_none(source: Name, target: Name) -> None:
    assert disjoint_paths(links_of([(A, B, 1), (C, D, 1)]), source, target) == ()


def test_a_leaf_without_outgoing_edges_is_no_transit() -> None:
    graph = links_of([(A, B, 1), (B, F, 1), (A, C, 1), (C, F, 1)])
    del graph[DirectedLink(C, F, 3)]
    assert [[link.key for link in path] for path in disjoint_paths(graph, A, F)] == [[0, 1]]
