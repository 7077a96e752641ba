"""Kinds of internet access: which pairs can be direct, and that the page says the same."""

from __future__ import annotations

from itertools import product

from lab.internet.access import TRAITS, Access, allows_direct, core_rules, router_rules
from tests.pages import ROOT

PAGE = ROOT / "docs/reference/internet-access.md"
KINDS = list(Access)


def table_after(heading: str) -> list[list[str]]:
    """Return the cells of the table of a section, its head first."""
    section = PAGE.read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows if not row[0].startswith("---")]


def test_a_pair_is_direct_in_either_order() -> None:
    assert all(allows_direct(a, b) is allows_direct(b, a) for a, b in product(KINDS, KINDS))


def test_a_public_host_is_direct_for_all_that_pass_udp() -> None:
    assert {each for each in KINDS if not allows_direct(Access.PUBLIC, each)} == {Access.UDP_BLOCKED}


def test_a_symmetric_nat_reaches_only_those_that_filter_nothing() -> None:
    direct = {each for each in KINDS if allows_direct(Access.SYMMETRIC, each)}
    assert direct == {each for each in KINDS if not TRAITS[each].is_filtering and TRAITS[each].passes_udp}


def test_the_page_states_which_pairs_are_direct() -> None:
    names = {each.value for each in KINDS}
    stated: dict[str, set[str]] = {}
    for row in table_after("The kinds")[1:]:
        listed = set(row[5].removeprefix("all but ").split(", ")) - {"none"}
        assert listed <= names
        stated[row[0]] = names - listed if row[5].startswith("all but ") else listed
    assert stated == {a.value: {b.value for b in KINDS if allows_direct(a, b)} for a in KINDS}
    assert f"In {sum(map(len, stated.values()))} of {len(KINDS) ** 2} pairs" in PAGE.read_text()


def test_the_page_states_the_traits_of_each_kind() -> None:
    rows = {row[0]: row[1:4] for row in table_after("The kinds")[1:]}
    assert list(rows) == [each.value for each in KINDS]
    for access, traits in TRAITS.items():
        versions, mapping, filtering = rows[access.value]
        assert versions == ", ".join(map(str, sorted(traits.versions)))
        assert (mapping == "one for each destination") is not traits.is_mapping_stable
        assert (filtering != "none") is traits.is_filtering


def test_public_access_has_no_rules() -> None:
    assert router_rules(Access.PUBLIC, "") == ""


def test_the_core_drops_in_both_directions_only_at_cut_sites() -> None:
    assert core_rules(["port0"]).count('"port0" drop\n') == 2
    assert " drop\n" not in core_rules([])
