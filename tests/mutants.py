"""Power of the tests: draws mutants of the product, and reports which of them the change lane kills.

    python -m tests.mutants --count 60 --seed 1

A mutant changes one comparison, operator, constant, condition or returned value. The tests of its file and package run
first. Those that live are put into one tree, on which journeys, attacks and all other tests in memory run once; each is
then judged alone by the tests that failed. With ``--nightly`` the nightly tests follow in the same way. Tests that need
namespaces are left out.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Final

ROOT: Final = Path(__file__).parents[1]
PACKAGES: Final = (
    "gdp/switch", "gdp/rib", "gdp/client", "gdp/exchange", "gdp/message", "gdp/crypto", "gdp/trust", "proxy/bridge",
)  # fmt: skip
_COPIED: Final = ("gdp", "proxy", "fog", "gdp_extensions", "tests", "scripts", "netns_tests", "examples", "docs")
_COMPARED: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
_COMPUTED: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.FloorDiv, ast.FloorDiv: ast.Mult,
}  # fmt: skip
_ALL: Final = ("tests/attacks", "tests/journeys", "tests/golden", "tests/proxy", "tests/gdp", "tests/gdp_extensions")
_TEST_S: Final = 2_400.0  # a mutant that hangs counts as killed


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one file.

    Args:
        where: number of the change among all that the file allows.
    """

    file: Path
    line: int
    where: int
    what: str


class _Changes(ast.NodeTransformer):
    """Lists the changes that a file allows, and makes the one with number ``wanted``."""

    def __init__(self, wanted: int = -1) -> None:
        self.found: list[tuple[int, str]] = []
        self._wanted = wanted

    def _is_wanted(self, node: ast.expr | ast.stmt, what: str) -> bool:
        self.found.append((node.lineno, what))
        return len(self.found) - 1 == self._wanted

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """Exchange a comparison for its neighbour or its opposite."""
        self.generic_visit(node)
        other = _COMPARED[type(node.ops[0])]
        if self._is_wanted(node, f"{type(node.ops[0]).__name__} -> {other.__name__}"):
            node.ops[0] = other()
        return node

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        """Exchange an operator of numbers."""
        self.generic_visit(node)
        other = _COMPUTED.get(type(node.op))
        is_text = any(isinstance(each, ast.Constant) and isinstance(each.value, str | bytes) for each in ast.walk(node))
        if other is not None and not is_text and self._is_wanted(node, f"{type(node.op).__name__} -> {other.__name__}"):
            node.op = other()
        return node

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        """Exchange ``and`` and ``or``."""
        self.generic_visit(node)
        if self._is_wanted(node, "and <-> or"):
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        return node

    def visit_If(self, node: ast.If) -> ast.AST:
        """Negate a condition."""
        self.generic_visit(node)
        if self._is_wanted(node, "condition negated"):
            node.test = ast.UnaryOp(ast.Not(), node.test)
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        """Add one to a number."""
        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            return node
        is_wanted = self._is_wanted(node, f"{value} -> {value + 1}")
        return ast.copy_location(ast.Constant(value + 1), node) if is_wanted else node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        """Leave out a call whose result is not used; never a docstring."""
        if isinstance(node.value, ast.Call) and self._is_wanted(node, "call left out"):
            return ast.copy_location(ast.Pass(), node)
        return node if isinstance(node.value, ast.Constant) else self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        """Change the value alone, not the annotation."""
        if node.value is not None:
            node.value = self.visit(node.value)
        return node


def drawn(count: int, seed: int) -> Iterator[Mutant]:
    """Yield mutants, as many of each package."""
    random = Random(seed)
    for number in range(count):
        files = sorted((ROOT / PACKAGES[number % len(PACKAGES)]).rglob("*.py"))
        sizes = {file: _allowed(file) for file in files}
        file = random.choices(files, [len(sizes[each]) for each in files])[0]
        where = random.randrange(len(sizes[file]))
        yield Mutant(file.relative_to(ROOT), sizes[file][where][0], where, sizes[file][where][1])


def _allowed(file: Path) -> list[tuple[int, str]]:
    changes = _Changes()
    changes.visit(ast.parse(file.read_text(encoding="utf-8")))
    return changes.found


def _suites(file: Path) -> Iterator[list[str]]:
    """Yield the tests of a file, and those of its package."""
    own = ROOT / "tests" / file.parent / f"test_{file.name}"
    if own.exists():
        yield [str(own.relative_to(ROOT))]
    yield [f"tests/{file.parent}"]


class _Tree:
    """A copy of the project, in which mutants are tried."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for each in _COPIED:
            shutil.copytree(ROOT / each, folder / each, ignore=shutil.ignore_patterns("__pycache__"))
        for each in ("pyproject.toml", "conftest.py", "README.md", "CHANGELOG.md", "CONTRIBUTING.md"):
            shutil.copy(ROOT / each, folder)
        self._environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(folder), str(folder / "scripts")))}

    @contextlib.contextmanager
    def changed(self, mutants: Sequence[Mutant]) -> Iterator[None]:
        """Apply mutants of different files for a while."""
        for mutant in mutants:
            source = ast.parse((ROOT / mutant.file).read_text(encoding="utf-8"))
            changed = ast.fix_missing_locations(_Changes(mutant.where).visit(source))
            (self._folder / mutant.file).write_text(ast.unparse(changed), encoding="utf-8")
        try:
            yield
        finally:
            for mutant in mutants:
                shutil.copy(ROOT / mutant.file, self._folder / mutant.file)

    def failed(self, tests: Sequence[str], *options: str) -> list[str]:
        """Run tests; return those that fail."""
        command = [sys.executable, "-m", "pytest", "-q", "-o", "addopts=", "-p", "no:cacheprovider", *options, *tests]
        try:
            done = subprocess.run(
                command, cwd=self._folder, env=self._environment, capture_output=True, text=True, check=False,
                timeout=_TEST_S,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return ["time"]
        if done.returncode in (0, 5):
            return []
        lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return [line.split(" ")[1] for line in lines] or ["import"]

    def judged(self, mutants: Sequence[Mutant], lane: str) -> dict[Mutant, str]:
        """Return the mutants that the tests of a lane kill, each with the test."""
        killed: dict[Mutant, str] = {}
        for group in _groups(mutants):
            with self.changed(group):
                suspects = self.failed(_ALL, "-n", "2", "-m", lane, "--maxfail", "40")
            for mutant in group if suspects else ():
                with self.changed([mutant]):
                    if found := self.failed(suspects, "-x", "-m", lane):
                        killed[mutant] = found[0]
        return killed


def _groups(mutants: Sequence[Mutant]) -> list[list[Mutant]]:
    """Return groups with one mutant of a file each."""
    groups: list[list[Mutant]] = []
    for mutant in mutants:
        group = next((each for each in groups if mutant.file not in {other.file for other in each}), None)
        if group is None:
            groups.append(group := [])
        group.append(mutant)
    return groups


def main() -> int:
    """Judge mutants, and print a line for each and their sum."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="mutants (60)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (1)")
    parser.add_argument("--nightly", action="store_true", help="judge those that live by the nightly tests too (hours)")
    options = parser.parse_args()
    alive: list[Mutant] = []
    with tempfile.TemporaryDirectory(prefix="gdp-mutants-") as name:
        tree = _Tree(Path(name))
        for number, mutant in enumerate(drawn(options.count, options.seed), 1):
            with tree.changed([mutant]):
                found = (tree.failed(suite, "-x", "-m", "not nightly") for suite in _suites(mutant.file))
                killer = next((each[0] for each in found if each), "")
            alive += [] if killer else [mutant]
            print(f"{number:3} {mutant.file}:{mutant.line} {mutant.what}: {killer or 'lives'}", flush=True)
        change = tree.judged(alive, "not nightly")
        rest = [each for each in alive if each not in change]
        nightly = tree.judged(rest, "nightly") if options.nightly else {}
    for mutant in alive:
        verdict = change.get(mutant) or (f"nightly only, {nightly[mutant]}" if mutant in nightly else "SURVIVED")
        print(f"{mutant.file}:{mutant.line} {mutant.what}: {verdict}")
    killed = options.count - len(alive) + len(change)
    more = f", the nightly tests {len(nightly)} more" if options.nightly else ""
    print(f"of {options.count}: the change lane kills {killed}{more}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
