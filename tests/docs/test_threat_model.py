"""Tables of the threat model: each answered attack names a test that exists, each open one has none."""

from __future__ import annotations

import ast
import functools
import itertools
import re
from typing import NamedTuple

from tests.pages import ROOT

PAGE = ROOT / "docs/explanation/threat-model.md"
RECORDED = frozenset(f"a{number:02}" for number in range(1, 77))  # the attacks that were once run against a commit
_TEST = re.compile(r"`((?:tests|netns_tests)/[\w/]+\.py)::(test_\w+)`")
_NAMED = re.compile(r"(?<![a-z0-9])([a-z]\d\d)(?![0-9])")


class Row(NamedTuple):
    """Attack of a table; the rows of answered ones begin with ids, and the heading above is their attacker."""

    id: str
    attacker: str
    cells: list[str]


def _part(heading: str) -> str:
    (part,) = (part for part in re.split(r"^## ", PAGE.read_text(), flags=re.M) if part.startswith(heading + "\n"))
    return part


def _rows(heading: str) -> list[Row]:
    found: list[Row] = []
    attacker = ""
    for line in _part(heading).splitlines():
        attacker = line.removeprefix("### ") if line.startswith("### ") else attacker
        if ids := re.match(r"\| ((?:[a-z]\d\d,?)+) ", line):
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
            found += [Row(each, attacker or cells[1], cells) for each in ids[1].split(",")]
    return found


ANSWERED = _rows("Attacks that are answered")
OPEN = _rows("Attacks that are open")


@functools.cache
def _tests_of(path: str) -> frozenset[str]:
    """Return the names of a module's tests, parametrised ones and those in classes too."""
    tree = ast.parse((ROOT / path).read_text())
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    return frozenset(node.name for node in functions if node.name.startswith("test_"))


def _named_in(path: str) -> set[str]:
    """Return the ids of attacks that a module's tests carry in their names: ``test_a01_a02_...``."""
    headers = (re.match(r"test_((?:[a-z]\d\d_)+)", name) for name in _tests_of(path))
    return {each for head in headers if head for each in _NAMED.findall(head[1].replace("_", " "))}


def test_every_answered_attack_names_a_test_that_exists() -> None:
    for row in ANSWERED:
        found = _TEST.findall(row.cells[-1])
        assert len(row.cells) == 3, row.id
        assert found, row.id
        for path, name in found:
            assert name in _tests_of(path), f"{row.id}: {path}::{name}"


def test_ids_are_unique_and_at_least_120_attacks_are_answered() -> None:
    ids = [row.id for row in (*ANSWERED, *OPEN)]
    assert len(set(ids)) == len(ids)
    assert all(re.fullmatch(r"[a-z]\d\d", each) for each in ids)
    assert len(ANSWERED) >= 120


def test_every_recorded_attack_is_answered_or_open() -> None:
    assert {row.id for row in (*ANSWERED, *OPEN)} >= RECORDED


def test_an_open_attack_is_a_recorded_one_or_one_that_the_models_found() -> None:
    assert {row.id for row in OPEN if not row.id.startswith("x")} <= RECORDED
    assert all(cell for row in OPEN for cell in row.cells)


def test_an_attack_that_a_test_is_named_after_is_not_open() -> None:
    named = {each: path for path in (ROOT / "tests/attacks").glob("test_*.py") for each in _named_in(str(path))}
    assert len(named) > 30
    assert {row.id: named[row.id].name for row in OPEN if row.id in named} == {}


def test_every_attacker_of_the_tables_is_introduced() -> None:
    introduced = {name.casefold() for name in re.findall(r"^- (.+?): ", _part("Attackers"), re.M)}
    assert {row.attacker.casefold() for row in (*ANSWERED, *OPEN)} <= introduced


def test_every_row_of_a_table_has_the_cells_of_its_head_and_none_stands_without_one() -> None:
    """A row among those of another table would be garbage on the page."""
    cells, wrong = 0, list[str]()  # of the head of the table
    for before, line in itertools.pairwise(["", *PAGE.read_text().splitlines()]):
        if not line.startswith("|"):
            continue
        found = len(re.split(r"(?<!\\)\|", line)) - 2
        if not before.startswith("|"):
            cells = found
        if found != cells:
            wrong.append(line)
    assert wrong == []


def test_a_row_with_ids_stands_below_attacks_only() -> None:
    whole = len(re.findall(r"^\| (?:[a-z]\d\d,?)+ ", PAGE.read_text(), re.M))
    assert whole == len({id(row.cells) for row in (*ANSWERED, *OPEN)})


def test_every_source_is_cited_and_every_citation_has_a_source() -> None:
    table, _, sources = _part("Compared with others").partition("Sources:")
    assert {*re.findall(r"\[(\d+)\]", table)} == {*re.findall(r"^(\d+)\. .*<https://\S+>$", sources, re.M)}
