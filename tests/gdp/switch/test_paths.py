"""Shortest paths: over links that both ends advertise, through permitted domains."""

from __future__ import annotations

from gdp.control.link_state import Scope
from gdp.switch.paths import Path, Paths
from tests.gdp.switch.net import AWAY, HOME, THIRD, known, link, name, paths, state

ALL = frozenset({HOME, AWAY, THIRD})


def first(path: Path | None) -> str | None:
    return None if path is None else path.first.rstrip(b"-").decode()


def test_the_cheaper_way_is_taken_though_it_is_longer() -> None:
    found = paths(
        "a",
        state("a", link("b", 5), link("c", 30)),
        state("b", link("a", 5), link("c", 5)),
        state("c", link("b", 5), link("a", 30)),
    )
    assert found.to_switch(name("c"), HOME, ALL) == Path(name("b"), 10)


def test_a_link_that_one_end_names_does_not_count() -> None:
    found = paths("a", state("a", link("b")), state("b"))
    assert found.to_switch(name("b"), HOME, ALL) is None


def test_each_direction_has_its_own_cost() -> None:
    found = paths("a", state("a", link("b", 7)), state("b", link("a", 900)))
    assert found.to_switch(name("b"), HOME, ALL) == Path(name("b"), 7)


def three_domains() -> Paths:
    """Return a's paths: a to the border x of AWAY at a high cost, or over the border t of THIRD at a low cost."""
    border = Scope.BORDER
    return paths(
        "a",
        state("a", link("x", 50, AWAY), link("t", 5, THIRD)),
        state("a", link("x", 50, AWAY), link("t", 5, THIRD), scope=border),
        state("x", link("a", 50, HOME), link("t", 5, THIRD), domain=AWAY, scope=border, ribs=("far rib",)),
        state("t", link("a", 5, HOME), link("x", 5, AWAY), domain=THIRD, scope=border),
    )


def test_a_link_is_the_only_way_unless_another_one_leads_to_the_neighbour() -> None:
    row = paths("a", state("a", link("b")), state("b", link("a"), link("c")), state("c", link("b")))
    assert row.is_only_way(name("b"))
    assert not three_domains().is_only_way(name("x"))
    assert row.is_only_way(name("a member, which is no switch"))


def test_a_border_that_has_just_started_knows_of_no_other_way() -> None:
    """Links of other domains are known, and of its own there is none that both ends list."""
    beyond = (
        state("x", link("a", 50, HOME), link("t", 5, THIRD), domain=AWAY, scope=Scope.BORDER),
        state("t", link("x", 5, AWAY), domain=THIRD, scope=Scope.BORDER),
    )
    assert paths("a", *beyond).is_only_way(name("x"))
    assert paths("a", state("a"), *beyond).is_only_way(name("x"))


def test_a_domain_that_is_not_allowed_is_gone_around() -> None:
    found = three_domains()
    assert found.to_switch(name("x"), AWAY, ALL) == Path(name("t"), 10)
    assert found.to_switch(name("x"), AWAY, frozenset({HOME, AWAY})) == Path(name("x"), 50)


def test_there_is_no_way_into_a_domain_that_is_not_allowed() -> None:
    assert three_domains().to_switch(name("x"), AWAY, frozenset({HOME, THIRD})) is None


def test_the_way_to_a_switch_behind_a_border_is_the_way_to_the_border() -> None:
    assert first(three_domains().to_switch(name("deep inside"), AWAY, ALL)) == "t"


def test_a_rib_may_stand_in_a_domain_that_is_not_passed_through() -> None:
    way, host = three_domains().to_rib(name("far rib"), frozenset({HOME}))
    assert (first(way), host) == ("x", name("x"))


def test_a_rib_at_ones_own_switch_needs_no_way() -> None:
    found = paths("a", state("a", ribs=("rib",)))
    assert found.to_rib(name("rib"), ALL) == (None, name("a"))
    assert set(found.ribs()) == {name("rib")}


def test_an_unnamed_rib_has_no_path() -> None:
    assert three_domains().to_rib(name("no rib"), ALL) == (None, None)


def test_at_home_borders_are_reached_by_links_and_not_by_what_they_tell_others() -> None:
    inside = (link("c", 10),)
    found = paths(
        "a",
        state("a", link("b", 5), link("x", 9, AWAY)),
        state("a", link("x", 9, AWAY), scope=Scope.BORDER, inside=inside),
        state("b", link("a", 5), link("c", 5)),
        state("c", link("b", 5), link("t", 9, THIRD)),
        state("c", link("t", 9, THIRD), scope=Scope.BORDER, inside=(link("a", 10),)),
    )
    assert found.to_switch(name("c"), HOME, ALL) == Path(name("b"), 10)


def test_another_domain_is_crossed_from_border_to_border() -> None:
    border = Scope.BORDER
    found = paths(
        "a",
        state("a", link("x", 5, AWAY)),
        state("a", link("x", 5, AWAY), scope=border),
        state("x", link("a", 5), domain=AWAY, scope=border, inside=(link("y", 20, AWAY),)),
        state("y", link("t", 5, THIRD), domain=AWAY, scope=border, inside=(link("x", 20, AWAY),)),
        state("t", link("y", 5, AWAY), domain=THIRD, scope=border),
    )
    assert found.to_switch(name("t"), THIRD, ALL) == Path(name("x"), 30)


def test_borders_are_those_of_our_domain_with_links_that_leave_it() -> None:
    found = paths(
        "a",
        state("a", link("b", 5)),
        state("b", link("a", 5), link("c", 5), link("x", 9, AWAY)),
        state("c", link("b", 5)),
    )
    assert found.borders() == {name("b"): 5}


def test_paths_follow_the_link_states() -> None:
    found = paths("a", state("a", link("b")), state("b", link("a")))
    assert found.to_switch(name("b"), HOME, ALL) is not None
    found.link_states.put(state("b", sequence=2), b"", 0.0)
    assert found.to_switch(name("b"), HOME, ALL) is None
    assert found.is_switch(name("b"))


def parted_home() -> Paths:
    """Return a's paths, whose domain is partitioned: d and its inner e are reached over x of AWAY only."""
    border = Scope.BORDER
    return paths(
        "a",
        state("a", link("b", 5), link("x", 5, AWAY)),
        state("b", link("a", 5)),
        state("d", link("e", 5), link("x", 5, AWAY)),
        state("d", link("x", 5, AWAY), scope=border, members=("d", "e"), ribs=("rib",)),
        state("e", link("d", 5), link("gone", 5)),
        state("x", link("a", 5), link("d", 5), domain=AWAY, scope=border),
    )


def test_a_part_of_our_domain_that_is_cut_off_is_reached_through_another_domain() -> None:
    assert parted_home().to_switch(name("e"), HOME, ALL) == Path(name("x"), 10)
    assert parted_home().to_rib(name("rib"), ALL) == (Path(name("x"), 10), name("d"))


def test_a_part_that_is_cut_off_is_not_reached_through_a_domain_that_is_not_allowed() -> None:
    assert parted_home().to_switch(name("e"), HOME, frozenset({HOME})) is None


def test_what_an_old_link_state_says_of_the_part_that_is_cut_off_is_not_believed() -> None:
    assert parted_home().to_switch(name("gone"), HOME, ALL) is None
    assert parted_home().members() == {name("a"), name("b")}


def test_of_two_parts_of_another_domain_the_one_that_lists_a_switch_leads_to_it() -> None:
    border = Scope.BORDER
    found = paths(
        "a",
        state("a", link("x", 5, AWAY), link("y", 50, AWAY)),
        state("x", link("a", 5), domain=AWAY, scope=border, members=("x",)),
        state("y", link("a", 50), domain=AWAY, scope=border, members=("y", "inner")),
    )
    assert found.to_switch(name("inner"), AWAY, ALL) == Path(name("y"), 50)


def square(ab: int = 10, ac: int = 10, bd: int = 10, cd: int = 10) -> Paths:
    """Return a's paths in the ring a, b, d, c, with alternates."""
    found = paths(
        "a",
        state("a", link("b", ab), link("c", ac)),
        state("b", link("a", ab), link("d", bd)),
        state("c", link("a", ac), link("d", cd)),
        state("d", link("b", bd), link("c", cd)),
    )
    found.has_alternates = True
    return found


def test_a_neighbour_whose_own_way_does_not_lead_back_is_an_alternate() -> None:
    assert square().to_switch(name("d"), HOME, ALL) == Path(name("b"), 20, name("c"))


def test_a_neighbour_whose_own_way_leads_back_is_no_alternate() -> None:
    assert square(cd=30).to_switch(name("d"), HOME, ALL) == Path(name("b"), 20, None)
    assert square(cd=29).to_switch(name("d"), HOME, ALL) == Path(name("b"), 20, name("c"))


def test_alternates_are_left_out_until_they_are_wanted() -> None:
    found = square()
    found.has_alternates = False
    assert found.to_switch(name("d"), HOME, ALL) == Path(name("b"), 20)


def test_a_neighbour_of_another_domain_is_no_alternate() -> None:
    found = three_domains()
    found.has_alternates = True
    assert found.to_switch(name("x"), AWAY, ALL) == Path(name("t"), 10, None)


def next_to_a_leaf(me: str, bd: int = 100, dear: int = 1) -> Paths:
    """Return the paths of ``me``, with alternates: a and d are joined by b, and by the leaf (``dear`` from a)."""
    found = paths(
        me,
        state("a", link("b"), link("leaf", dear)),
        state("b", link("a"), link("d", bd)),
        state("leaf", link("a", dear), link("d", 1), is_leaf=True),
        state("d", link("b", bd), link("leaf", 1), ribs=("rib",)),
    )
    found.has_alternates = True
    return found


def test_a_way_leads_to_a_leaf_and_never_through_one() -> None:
    found = next_to_a_leaf("a")
    assert found.to_switch(name("d"), HOME, ALL) == Path(name("b"), 110)
    assert found.to_switch(name("leaf"), HOME, ALL) == Path(name("leaf"), 1)
    assert found.to_rib(name("rib"), ALL) == (Path(name("b"), 110), name("d"))


def test_a_leaf_is_an_alternate_to_itself_only() -> None:
    found = next_to_a_leaf("a", 10, dear=500)
    assert found.to_switch(name("leaf"), HOME, ALL) == Path(name("b"), 21, name("leaf"))
    assert found.to_switch(name("d"), HOME, ALL) == Path(name("b"), 20, None)


def test_a_leaf_itself_takes_either_neighbour_for_nothing_comes_back_through_it() -> None:
    found = next_to_a_leaf("leaf")
    assert found.to_switch(name("b"), HOME, ALL) == Path(name("a"), 11, name("d"))
    assert found.to_switch(name("d"), HOME, ALL) == Path(name("d"), 1, name("a"))
    assert found.distance_from(name("leaf"), name("d"), HOME, ALL) is None


def test_what_only_leaves_join_is_severed_and_no_member() -> None:
    found = paths(
        "a",
        state("a", link("leaf")),
        state("leaf", link("a"), link("d"), link("far"), is_leaf=True),
        state("far", link("leaf"), is_leaf=True),
        state("d", link("leaf"), link("e", 5, AWAY)),
    )
    assert found.to_switch(name("d"), HOME, ALL) is None
    assert found.severed() == {name("d"), name("far")}
    assert found.members() == {name("a"), name("leaf")}
    assert found.leads_through_leaf(name("d"), HOME)
    assert found.leads_through_leaf(name("e"), AWAY)
    assert not found.leads_through_leaf(name("unknown"), HOME)
    assert found.borders() == {}


def test_a_switch_whose_root_made_it_a_leaf_is_passed_through_no_more() -> None:
    states = known(
        state("a", link("b")), state("b", link("a"), link("c")), state("c", link("b")),
    )  # fmt: skip
    found = Paths(name("a"), HOME, states)
    assert first(found.to_switch(name("c"), HOME, ALL)) == "b"
    states.put(state("b", link("a"), link("c"), sequence=2, is_leaf=True), b"wire", 0.0)
    assert found.to_switch(name("c"), HOME, ALL) is None
