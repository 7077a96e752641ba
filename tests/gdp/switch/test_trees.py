"""Trees: a copy for each branch, soft state that ends by itself."""

from __future__ import annotations

from gdp.switch.trees import Branch, Tree, Trees
from tests.gdp.switch.net import HOME, name

NEAR, FAR = (0, b"\x02nearr"), (1, b"\x02farrr")


def tree(topic: str = "topic", publisher: str = "robot") -> Tree:
    made = Tree(name(topic), name(publisher), name("switch"), HOME, frozenset({HOME}))
    made.branches = {FAR: Branch(9.0, 1_400, b"far claim"), NEAR: Branch(5.0, 1_500, b"near claim")}
    made.renew_at_s = 7.0
    return made


def test_a_tree_has_a_hop_for_each_branch_on_a_port_that_is_up() -> None:
    macs = {0: b"\x02own00", 1: b"\x02own01"}
    assert tree().hops(macs) == ((0, NEAR[1] + macs[0]), (1, FAR[1] + macs[1]))
    assert tree().hops({1: macs[1]}) == ((1, FAR[1] + macs[1]),)


def test_a_tree_carries_what_fits_its_narrowest_branch() -> None:
    assert tree().mtu == 1_400


def test_a_tree_shows_the_claim_that_stands_longest() -> None:
    assert (tree().evidence, tree().expires_s()) == (b"far claim", 9.0)


def test_a_branch_that_is_not_renewed_is_cut() -> None:
    trees, one = Trees(), tree()
    trees.put(one)
    assert trees.next_event() == 5.0
    assert trees.prune(4.9) == []
    assert trees.prune(5.0) == [one]
    assert list(one.branches) == [FAR]
    assert trees.next_event() == 7.0


def test_trees_of_one_topic_are_found_by_it() -> None:
    trees = Trees()
    for each in (tree(), tree(publisher="second"), tree(topic="other")):
        trees.put(each)
    assert {each.publisher for each in trees.of_topic(name("topic"))} == {name("robot"), name("second")}
    trees.remove(tree())
    assert (len(trees), trees.get(name("topic"), name("robot"))) == (2, None)


def test_a_branch_is_as_narrow_as_its_link_or_the_way_behind_it() -> None:
    branch = Branch(9.0, 1_400, b"claim", said_mtu=1_400)
    seen = []
    for link_mtu in (9_000, 1_000, 1_500):
        branch.fit(link_mtu)
        seen.append(branch.mtu)
    assert seen == [1_400, 1_000, 1_400]
