"""Multicast trees: a copy for each branch, soft state that expires by itself."""

from __future__ import annotations

from gdp.switch.trees import Branch, Tree, Trees
from tests.gdp.switch.net import HOME, name

NEAR, FAR = (0, b"\x02nearr"), (1, b"\x02farrr")


def tree(topic: str = "topic", publisher: str = "robot") -> Tree:
    made = Tree(
        topic=name(topic), publisher=name(publisher), switch=name("switch"), domain=HOME, allowed=frozenset({HOME})
    )
    made.branches = {
        FAR: Branch(expires_s=9.0, mtu=1_400, evidence=b"far claim"),
        NEAR: Branch(expires_s=5.0, mtu=1_500, evidence=b"near claim"),
    }
    made.renew_at_s = 7.0
    return made


def test_a_tree_has_a_hop_for_each_branch_on_a_port_that_is_up() -> None:
    macs = {0: b"\x02own00", 1: b"\x02own01"}
    assert tree().hops(macs) == ((0, NEAR[1] + macs[0]), (1, FAR[1] + macs[1]))
    assert tree().hops({1: macs[1]}) == ((1, FAR[1] + macs[1]),)


def test_a_tree_carries_what_fits_its_narrowest_branch() -> None:
    assert tree().mtu == 1_400


def test_a_tree_shows_the_advertisement_that_stands_longest() -> None:
    assert (tree().evidence, tree().expires_s()) == (b"far claim", 9.0)


def test_a_branch_that_is_not_renewed_is_cut() -> None:
    trees, one = Trees(), tree()
    trees.put(one)
    one.renew_at_s = 6.0
    assert trees.next_event() == 5.0
    assert trees.due(4.9) == []
    assert trees.due(5.0) == [one]
    del one.branches[NEAR]
    assert trees.next_event() == 6.0
    one.renew_at_s = 8.0
    assert trees.due(6.0) == [one]
    assert trees.next_event() == 8.0


def test_trees_of_one_topic_are_found_by_it() -> None:
    trees = Trees()
    for each in (tree(), tree(publisher="second"), tree(topic="other")):
        trees.put(each)
    assert {each.publisher for each in trees.of_topic(name("topic"))} == {name("robot"), name("second")}
    trees.remove(tree())
    assert (len(trees), trees.get(name("topic"), name("robot"))) == (2, None)


def test_a_branch_is_as_narrow_as_its_link_or_the_way_behind_it() -> None:
    branch = Branch(expires_s=9.0, mtu=1_400, evidence=b"claim", said_mtu=1_400)
    seen = []
    for link_mtu in (9_000, 1_000, 1_500):
        branch.fit(link_mtu)
        seen.append(branch.mtu)
    assert seen == [1_400, 1_000, 1_400]


OTHER = (2, b"\x02other")
MACS = {0: b"\x02own00", 1: b"\x02own01", 2: b"\x02own02"}


def with_backup() -> Tree:
    """Return a tree with a backup that protects the branch FAR."""
    made = tree()
    made.branches[OTHER] = Branch(expires_s=20.0, mtu=900, evidence=b"its claim", backup_for=name("below"))
    made.protection = {FAR: OTHER}
    return made


def test_a_backup_is_the_alternate_of_the_branch_that_it_protects() -> None:
    assert with_backup().hops(MACS) == (
        (0, NEAR[1] + MACS[0]),
        (1, FAR[1] + MACS[1], 2, OTHER[1] + MACS[2]),
    )


def test_a_backup_on_a_port_that_is_down_or_leads_back_up_is_no_alternate() -> None:
    plain = ((0, NEAR[1] + MACS[0]), (1, FAR[1] + MACS[1]))
    made = with_backup()
    assert made.hops({port: mac for port, mac in MACS.items() if port != 2}) == plain
    made.upstream = OTHER
    assert made.hops(MACS) == plain


def test_a_backup_counts_neither_for_the_mtu_nor_for_the_evidence_until_it_is_needed() -> None:
    made = with_backup()
    assert (made.mtu, made.evidence, made.backup_for) == (1_400, b"far claim", None)
    made.branches[OTHER].active_until_s = 3.0
    assert (made.mtu, made.evidence, made.backup_for) == (900, b"its claim", None)


def test_a_tree_of_backups_alone_asks_for_a_backup_and_passes_on_what_comes() -> None:
    made = with_backup()
    del made.branches[FAR], made.branches[NEAR]
    assert (made.backup_for, made.is_backup, made.mtu) == (name("below"), True, 900)
    assert made.hops(MACS) == ((2, OTHER[1] + MACS[2]),)


def test_a_backup_that_got_copies_is_due_when_its_time_is_over() -> None:
    trees, made = Trees(), with_backup()
    trees.put(made)
    made.branches[OTHER].active_until_s = 3.0
    assert trees.next_event() == 3.0
    assert trees.due(2.9) == []
    assert trees.due(3.0) == [made]
    made.branches[OTHER].active_until_s = None
    assert trees.next_event() == 5.0
