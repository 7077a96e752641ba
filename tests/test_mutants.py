"""Changes that the command of mutants draws: behaviour, never text, types or arguments that checkers alone read."""

from __future__ import annotations

import ast

import pytest

from tests.mutants import PACKAGES, _sites, drawn


def changes(text: str) -> set[str]:
    return {site.change for site in _sites(ast.parse(text))}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a < b", {"a < b -> a <= b", "a < b -> a >= b"}),
        ("a is None", {"a is None -> a is not None"}),
        ("a and b", {"a and b -> a or b"}),
        ("a + b", {"a + b -> a - b"}),
        ("x = 5", {"5 -> 6", "5 -> 4"}),
        ("x = True", {"True -> False"}),
        ("while a: pass", {"a -> not a"}),
        ("forget(a)", {"forget(a) -> pass"}),
        ("self.a += b", {"self.a += b -> pass"}),
        ("def f(): return a", {"a -> None"}),
    ],
)
def test_a_line_changes_in_these_ways(text: str, found: set[str]) -> None:
    assert changes(text) == found


@pytest.mark.parametrize(
    "text",
    [
        '"""One of 3."""',
        "def f(a: Literal[3]) -> Literal[4]: pass",
        "a: Literal[3]",
        "self._log.info('after %d', 1 + a)",
        "def __repr__(self): return a + b",
        "if TYPE_CHECKING:\n    x = 3",
        "@dataclass(slots=True)\nclass A: pass",
        "for a, b in zip(c, d, strict=True): pass",
        "f'{a:3}'",
    ],
)
def test_text_and_types_do_not_change(text: str) -> None:
    assert changes(text) == set()


def test_every_change_is_another_program() -> None:
    text = "def f(a, b):\n    if a < b and a:\n        b.c = a - 1\n        b.d()\n    return [a, b][0]\n"
    count = len(list(_sites(ast.parse(text))))
    programs = {text}
    for number in range(count):
        tree = ast.parse(text)
        site = list(_sites(tree))[number]
        site.put(site.new)
        programs.add(ast.unparse(ast.fix_missing_locations(tree)))
    assert len(programs) == count + 1


def test_probes_of_all_changes_leave_a_program_as_it_is() -> None:
    text = "def f(a):\n    found = []\n    if a < 3 and not a == 1:\n        found.append(a + 1)\n    return found\n"
    tree = ast.parse(text)
    for number, site in enumerate(_sites(tree)):
        site.probe(number)
    plain: dict[str, object] = {}
    probed: dict[str, object] = {}
    exec(text, plain)
    exec(compile(ast.fix_missing_locations(tree), "probed", "exec"), probed)
    results = [[f(a) for a in range(5)] for f in (plain["f"], probed["f"]) if callable(f)]
    assert results[0] == results[1] == [[1], [], [3], [], []]


def test_a_seed_draws_the_same_mutants_and_another_one_others() -> None:
    one = drawn(8, 1)
    assert one == drawn(8, 1) != drawn(8, 2)
    assert all(row["file"].startswith(PACKAGES) for row in one)
