"""Shortest paths: over links that both ends name, through domains that are allowed."""

from __future__ import annotations

from gdp.control.link_state import Scope
from gdp.switch.paths import Paths, Way
from tests.gdp.switch.net import AWAY, HOME, THIRD, link, name, paths, state

ALL = frozenset({HOME, AWAY, THIRD})


def first(way: Way | None) -> str | None:
    return None if way is None else way.first.rstrip(b"-").decode()


def test_the_cheaper_way_is_taken_though_it_is_longer() -> None:
    found = paths(
        "a",
        state("a", link("b", 5), link("c", 30)),
        state("b", link("a", 5), link("c", 5)),
        state("c", link("b", 5), link("a", 30)),
    )
    assert found.to_switch(name("c"), HOME, ALL) == Way(name("b"), 10)


def test_a_link_that_one_end_names_does_not_count() -> None:
    found = paths("a", state("a", link("b")), state("b"))
    assert found.to_switch(name("b"), HOME, ALL) is None


def test_each_direction_has_its_own_cost() -> None:
    found = paths("a", state("a", link("b", 7)), state("b", link("a", 900)))
    assert found.to_switch(name("b"), HOME, ALL) == Way(name("b"), 7)


def three_domains() -> Paths:
    """Return a's paths: a to the border x of AWAY, dear; or over the border t of THIRD, cheap."""
    border = Scope.BORDER
    return paths(
        "a",
        state("a", link("x", 50, AWAY), link("t", 5, THIRD)),
        state("a", link("x", 50, AWAY), link("t", 5, THIRD), scope=border),
        state("x", link("a", 50, HOME), link("t", 5, THIRD), domain=AWAY, scope=border, ribs=("far rib",)),
        state("t", link("a", 5, HOME), link("x", 5, AWAY), domain=THIRD, scope=border),
    )


def test_a_domain_that_is_not_allowed_is_gone_around() -> None:
    found = three_domains()
    assert found.to_switch(name("x"), AWAY, ALL) == Way(name("t"), 10)
    assert found.to_switch(name("x"), AWAY, frozenset({HOME, AWAY})) == Way(name("x"), 50)


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
    assert found.ribs() == {name("rib")}


def test_a_rib_that_nobody_names_is_nowhere() -> None:
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
    assert found.to_switch(name("c"), HOME, ALL) == Way(name("b"), 10)


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
    assert found.to_switch(name("t"), THIRD, ALL) == Way(name("x"), 30)


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
    found._link_states.put(state("b", sequence=2), b"", 0.0)
    assert found.to_switch(name("b"), HOME, ALL) is None
    assert found.is_switch(name("b"))
