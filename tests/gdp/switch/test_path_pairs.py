"""Path pairs: what works is moved for a better pair only, and never both paths at once."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from gdp.control.join import ROUTE_MAX
from gdp.control.link_state import Adjacency, Scope, link_key
from gdp.switch.lsdb import LinkStateDatabase
from gdp.switch.path_pairs import SETTLE_S, PathPair, PathPairs
from gdp.switch.paths import Paths
from tests.gdp.switch.net import AWAY, HOME, name, state

Links = tuple[tuple[str, str, int], ...]  # two switches and a cost; the place is the key
UPLINKS: Links = (("me", "border", 10), ("me", "border", 20), ("border", "server", 10))
NODES = ("me", "b", "c", "server")


class Network:
    """Link states that change, and the pairs of the switch ``me``."""

    def __init__(self, links: Links, *, leaves: tuple[str, ...] = ()) -> None:
        self.links = links
        self._leaves = leaves
        self._database = LinkStateDatabase(HOME)
        self._paths = Paths(name("me"), HOME, self._database)
        self.pairs = PathPairs(name("me"), self._paths)
        self._sequence = 0
        self.set()

    def set(self, *, without: frozenset[int] = frozenset(), costs: dict[int, int] | None = None) -> None:
        """Flood the link states without some links, and with other costs of some."""
        self._sequence += 1
        ends = {end for link in self.links for end in link[:2]}
        for origin in ends:
            links = tuple(
                Adjacency(name(b if origin == a else a), HOME, (costs or {}).get(key, cost), 1_500, key)
                for key, (a, b, cost) in enumerate(self.links)
                if origin in (a, b) and key not in without
            )
            made = state(origin, *links, sequence=self._sequence, is_leaf=origin in self._leaves)
            self._database.put(made, b"wire", 0.0)

    def pair(self, now_s: float, to: str = "server") -> PathPair | None:
        """Return the present pair to a switch."""
        return self.pairs.to(name(to), HOME, now_s)

    def keys(self, now_s: float) -> tuple[list[int], list[int]] | None:
        """Return the keys of the links of both paths."""
        found = self.pair(now_s)
        return None if found is None else ([link.key for link in found.first], [link.key for link in found.second])


def test_both_ends_of_a_link_compute_one_key_which_other_links_do_not_change() -> None:
    one, other = b"\x02aaaaa", b"\x02bbbbb"
    assert link_key(one, other) == link_key(other, one)
    assert link_key(one, other) != link_key(one, b"\x02ccccc")


def test_two_links_between_two_switches_are_two_paths_and_what_follows_is_shared() -> None:
    network = Network(UPLINKS)
    assert network.keys(0.0) == ([0, 2], [1, 2])
    pair = network.pair(0.0)
    assert pair is not None
    assert pair.is_shared


def test_a_lost_link_leaves_no_pair_and_its_return_moves_the_lost_path_alone() -> None:
    network = Network(UPLINKS)
    assert network.keys(0.0) == ([0, 2], [1, 2])
    network.set(without=frozenset({0}))
    assert network.keys(1.0) is None
    network.set()
    assert network.keys(2.0) in (([0, 2], [1, 2]), ([1, 2], [0, 2]))


def test_a_cheaper_pair_is_followed_only_where_it_is_worth_it_and_one_path_after_the_other() -> None:
    links = (("me", "b", 10), ("b", "server", 10), ("me", "c", 10), ("c", "server", 11))
    network = Network((*links, ("me", "server", 30), ("me", "server", 31)))
    assert network.keys(0.0) == ([0, 1], [2, 3])
    network.set(costs={4: 19, 5: 19})
    assert network.keys(10.0) == ([0, 1], [2, 3])
    network.set(costs={4: 1, 5: 1})
    first = network.keys(20.0)
    assert first in (([0, 1], [4]), ([0, 1], [5]))
    assert network.keys(20.0 + SETTLE_S / 2) == first
    assert network.pairs.get_timer() == 20.0 + SETTLE_S
    network.pairs.handle_timer(20.0 + SETTLE_S)
    assert sorted(map(tuple, network.keys(20.0 + SETTLE_S) or ())) == [(4,), (5,)]
    assert network.pairs.get_timer() is None


def test_no_path_leads_through_a_leaf() -> None:
    network = Network((("me", "b", 10), ("b", "server", 10), ("me", "server", 10)), leaves=("b",))
    assert network.pair(0.0) is None


def test_a_path_above_the_longest_route_makes_no_pair() -> None:
    nodes = ["me", *(f"n{number}" for number in range(ROUTE_MAX)), "server"]
    row = tuple((a, b, 1) for a, b in pairwise(nodes))
    assert Network((*row, ("me", "server", 1))).pair(0.0) is None
    assert Network((*row[1:], ("me", "n1", 1), ("me", "server", 1))).pair(0.0) is not None


def test_to_another_domain_the_paths_end_at_its_borders() -> None:
    database = LinkStateDatabase(HOME)
    inside = [("me", "x", 1), ("me", "y", 1)]
    joints = [("x", "far1", 2), ("y", "far2", 2)]
    for origin in ("me", "x", "y"):
        links = [
            Adjacency(name(b if a == origin else a), HOME, 1, 1_500, key) for a, b, key in inside if origin in (a, b)
        ]
        leaving = [Adjacency(name(b), AWAY, 1, 1_500, key) for a, b, key in joints if a == origin]
        database.put(state(origin, *links, *leaving), b"wire", 0.0)
    for a, b, key in joints:
        made = state(
            b,
            Adjacency(name(a), HOME, 1, 1_500, key),
            domain=AWAY,
            scope=Scope.BORDER,
            members=("far1", "far2", "deep"),
        )
        database.put(made, b"wire", 0.0)
    pairs = PathPairs(name("me"), Paths(name("me"), HOME, database))
    pair = pairs.to(name("deep"), AWAY, 0.0)
    assert pair is not None
    assert {route[-1].name for route in pair} == {name("far1"), name("far2")}
    assert [len(route) for route in pair] == [2, 2]


LINKS = st.lists(st.tuples(st.sampled_from(NODES), st.sampled_from(NODES), st.integers(1, 9)), min_size=2, max_size=10)


@given(LINKS, st.lists(st.tuples(st.frozensets(st.integers(0, 9), max_size=2), st.floats(0.0, 3.0)), max_size=8))
def test_of_two_paths_that_work_at_most_one_is_moved_at_a_time(
    drawn: list[tuple[str, str, int]], changes: list[tuple[frozenset[int], float]]
) -> None:
    links = tuple((a, b, cost) for a, b, cost in (*drawn, ("me", "server", 5), ("b", "c", 1)) if a != b)
    network, now_s, before = Network(links), 0.0, None
    for without, after_s in changes:
        now_s += after_s
        network.set(without=without)
        now = network.pair(now_s)
        if before is not None and now is not None:
            works = [not {link.key for link in route} & without for route in before]
            moved = [one != other for one, other in zip(before, now, strict=True)]
            assert not (all(works) and all(moved))
            if works.count(True) == 1:
                assert not moved[works.index(True)]
        for route in now or ():
            assert not {link.key for link in route} & without
        before = now
