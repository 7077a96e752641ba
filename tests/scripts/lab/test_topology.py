"""Topologies as data."""

from __future__ import annotations

from dataclasses import replace

import networkx as nx
import pytest

from gdp.errors import LocalError
from lab.topology import Attachment, DomainPlan, Link, Topology, chain, ring5


def cheapest(topology: Topology, a: str, b: str) -> list[str]:
    graph: nx.Graph[str] = nx.Graph()
    for link in topology.links:
        graph.add_edge(link.a, link.b, weight=link.cost)
    path: list[str] = nx.shortest_path(graph, a, b, weight="weight")
    return path


def test_the_usual_way_round_the_ring_has_three_switches_in_between() -> None:
    assert cheapest(ring5(), "nuc1", "nuc5") == ["nuc1", "nuc2", "nuc3", "nuc4", "nuc5"]


def test_without_a_link_of_the_usual_way_the_ring_is_closed_by_the_dear_one() -> None:
    ring = ring5()
    rest = replace(ring, links=tuple(link for link in ring.links if link != ring.link("nuc3", "nuc2")))
    assert cheapest(rest, "nuc1", "nuc5") == ["nuc1", "nuc5"]


def test_each_domain_of_the_ring_has_its_rib_and_the_backbone_s_is_above() -> None:
    ring = ring5()
    ribs = {domain.label: ring.rib_of(domain.label) for domain in ring.domains}
    assert {label: rib.switch for label, rib in ribs.items() if rib} == {
        "school": "nuc2",
        "backbone": "nuc3",
        "cloud": "nuc4",
    }
    assert {domain.label: domain.upper for domain in ring.domains} == {
        "school": "backbone",
        "backbone": None,
        "cloud": "backbone",
    }


def test_robot_and_server_stand_at_the_ends() -> None:
    assert [at.switch for at in ring5().attached("proxy")] == ["nuc1", "nuc5"]
    assert ring5().domain_of("nuc5").label == "cloud"


def test_the_mtu_holds_for_every_link() -> None:
    assert {link.mtu for link in ring5(9_000).links} == {9_000}


@pytest.mark.parametrize("length", [1, 2, 200])
def test_a_chain_joins_each_switch_to_the_next(length: int) -> None:
    row = chain(length)
    assert len(row.nodes) == length
    assert len(row.links) == length - 1
    assert [at.switch for at in row.attached("proxy")] == [row.nodes[0], row.nodes[-1]]


A, B = "a", "b"
TWO = DomainPlan("d", (A, B))


@pytest.mark.parametrize(
    ("links", "domains", "attachments"),
    [
        ((Link(A, "z"),), (TWO,), ()),
        ((Link(A, A),), (TWO,), ()),
        ((Link(A, B), Link(B, A)), (TWO,), ()),
        ((Link(A, B, cost=0),), (TWO,), ()),
        ((Link(A, B, mtu=575),), (TWO,), ()),
        ((Link(A, B, mtu=65_522),), (TWO,), ()),
        ((), (TWO, DomainPlan("e", (B,))), ()),
        ((), (TWO, DomainPlan("d", ("c",))), ()),
        ((), (DomainPlan("d", (A,), upper="unknown"),), ()),
        ((), (DomainPlan("d", (A,), upper="d"),), ()),
        ((), (DomainPlan("d", ("a_very_long_name",)),), ()),
        ((), (TWO,), (Attachment("z", "rib", "rib"),)),
        ((), (TWO,), (Attachment(A, "rib", "x"), Attachment(A, "proxy", "x"))),
        ((), (TWO,), (Attachment(A, "rib", B),)),
    ],
)
def test_what_does_not_fit_together_is_refused(
    links: tuple[Link, ...], domains: tuple[DomainPlan, ...], attachments: tuple[Attachment, ...]
) -> None:
    with pytest.raises(LocalError):
        Topology(links, domains, attachments)


def test_a_missing_link_is_reported_with_the_existing_ones() -> None:
    with pytest.raises(LocalError, match="no link nuc1-nuc3; there are nuc1-nuc2, nuc2-nuc3"):
        ring5().link("nuc1", "nuc3")
