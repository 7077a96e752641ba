"""Power of the tests: draws mutants of the product, and reports which tests of the change lane kill each.

    python -m tests.mutants --count 60 --seed 1        judge sixty; run it again to go on after an interruption
    python -m tests.mutants --count 60 --seed 1 --list print the draw alone

The change lane first runs once on a copy of the tree, which notes the tests that reach each mutant. A mutant then meets
these until one fails, or takes ten times as long: first those of its package, then golden traces, then the others.
``.ci/out/mutants-SEED.jsonl`` has a line for each mutant. ``"equivalent": "why"`` in a line says that a mutant changes
no behaviour. Other survivors are judged again, by new tests too. Tests that need namespaces are left out.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).parents[1]
PACKAGES: Final = ("gdp/switch", "gdp/rib", "gdp/client", "gdp/message", "gdp/crypto", "gdp/trust", "proxy/bridge")
STAGES: Final = ("own", "golden", "others")  # tests of the package, golden traces, all others in memory
_LANE: Final = ("tests/attacks", "tests/journeys", "tests/golden", "tests/gdp", "tests/gdp_extensions", "tests/proxy")
_NOTES: Final = "GDP_MUTANTS"  # file in which a run notes what its tests do
_LIMIT: Final = "GDP_MUTANTS_LIMIT"  # seconds of a test
_COMPARED: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
}  # fmt: skip
_DROPPED: Final = (ast.AugAssign, ast.Delete, ast.Raise, ast.Break, ast.Continue)
_UNCHANGED: Final = frozenset({"annotation", "returns", "format_spec", "decorator_list", "pattern", "bases"})
_CHECKED_ELSEWHERE: Final = frozenset({"strict", "frozen", "slots", "kw_only", "stacklevel"})  # arguments

Row = dict[str, Any]  # a line of the outcome


class Site(NamedTuple):
    """A node that changes: where it hangs in its tree, and what replaces it."""

    parent: ast.AST
    field: str
    at: int
    node: ast.expr | ast.stmt
    new: ast.AST

    @property
    def change(self) -> str:
        """Return the change as one line."""
        return " ".join(f"{ast.unparse(self.node)} -> {ast.unparse(self.new)}".split())

    def put(self, node: ast.AST) -> None:
        """Hang a node in its place."""
        value = getattr(self.parent, self.field)
        if isinstance(value, list):
            value[self.at] = node
        else:
            setattr(self.parent, self.field, node)

    def probe(self, number: int) -> None:
        """Note each test that runs this place; several mutants may share it."""
        value = getattr(self.parent, self.field)
        value = value[self.at] if isinstance(value, list) else value
        call = ast.parse(f"__import__('tests.mutants').mutants.reached({number})", mode="eval").body
        pair = ast.Subscript(ast.Tuple([call, value], ast.Load()), ast.Constant(1), ast.Load())
        self.put(ast.If(call, [value], []) if isinstance(value, ast.stmt) else pair)


def _sites(node: ast.AST) -> Iterator[Site]:
    for field, value in ast.iter_fields(node):
        for index, child in enumerate(value if isinstance(value, list) else [value]):
            if field in _UNCHANGED or not isinstance(child, ast.AST) or _is_left(child):
                continue
            if isinstance(child, ast.expr | ast.stmt):
                yield from (Site(node, field, index, child, new) for new in _changes(node, field, child))
            yield from _sites(child)


def _is_left(node: ast.AST) -> bool:
    if isinstance(node, ast.FunctionDef):
        return node.name == "__repr__"
    if isinstance(node, ast.If):
        return ast.unparse(node.test) == "TYPE_CHECKING"
    if isinstance(node, ast.Expr):
        text = ast.unparse(node.value).partition("(")[0].rpartition(".")[0]
        return isinstance(node.value, ast.Constant) or text.endswith(("log", "logger", "logging"))
    return isinstance(node, ast.keyword) and node.arg in _CHECKED_ELSEWHERE


def _changes(parent: ast.AST, field: str, node: ast.expr | ast.stmt) -> Iterator[ast.AST]:
    match node:
        case ast.Compare():
            for at, op in enumerate(node.ops):
                for other in _COMPARED[type(op)]:
                    yield ast.Compare(node.left, [*node.ops[:at], other(), *node.ops[at + 1 :]], node.comparators)
        case ast.BoolOp():
            yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        case ast.BinOp(op=ast.Add()) if not isinstance(node.right, ast.Tuple | ast.List | ast.JoinedStr):
            yield ast.BinOp(node.left, ast.Sub(), node.right)
        case ast.BinOp(op=ast.Sub()):
            yield ast.BinOp(node.left, ast.Add(), node.right)
        case ast.Constant(value=bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield from (ast.Constant(value + 1), ast.Constant(value - 1))
        case ast.Expr(value=ast.Call() | ast.Await()):
            yield ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield ast.Pass()
        case ast.stmt() if isinstance(node, _DROPPED):
            yield ast.Pass()
    if isinstance(node, ast.expr) and field == "test" and isinstance(parent, ast.If | ast.While | ast.IfExp):
        yield ast.UnaryOp(ast.Not(), node)
    if isinstance(parent, ast.Return) and not isinstance(node, ast.Constant):
        yield ast.Constant(None)


def drawn(count: int, seed: int) -> list[Row]:
    """Return mutants: a file by its lines, then one of its changes; ``site`` is its number among them."""
    random, rows = Random(seed), list[Row]()
    files = [each for package in PACKAGES for each in sorted((ROOT / package).rglob("*.py")) if each.stem != "__init__"]
    lines = [each.read_text().count("\n") for each in files]
    while len(rows) < count:
        (file,) = random.choices(files, lines)
        sites = list(_sites(ast.parse(file.read_text())))
        if not sites:
            continue
        number = random.randrange(len(sites))
        site = sites[number]
        row = {"file": str(file.relative_to(ROOT)), "line": site.node.lineno, "change": site.change, "site": number}
        rows += [row] if row not in rows else []
    return rows


def reached(number: int, _seen: set[tuple[int, str]] = set()) -> bool:  # noqa: B006
    """Note that the current test runs the place of a mutant; without a name: each import of it does."""
    seen = number, os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
    if seen not in _seen:
        _seen.add(seen)
        _note(seen)
    return True


def _note(value: object) -> None:
    if notes := os.environ.get(_NOTES):
        with open(notes, "a", encoding="utf-8") as out:
            out.write(json.dumps(value) + "\n")


def pytest_runtest_logstart() -> None:
    """End this process if the test hangs; this module is a plugin of the runs that it starts."""
    signal.alarm(int(os.environ.get(_LIMIT, "0")))


def pytest_runtest_logreport(report: Any) -> None:
    """Note how long a test took; below zero: it failed."""
    if "PYTEST_XDIST_WORKER" not in os.environ and (report.when == "call" or report.failed):
        _note([report.nodeid, report.duration if report.passed else -1.0])


class _Tree:
    """A copy of the project, in which mutants are tried."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._root, self._notes = folder, folder / "tree", folder / "notes"
        unused = shutil.ignore_patterns(".git", ".venv", ".ci", "__pycache__", ".*_cache")
        shutil.copytree(ROOT, self._root, ignore=unused)

    def write(self, file: str, rows: Iterable[tuple[int, Row]] = (), *, probes: bool = False) -> bool:
        """Write a file of the product with mutants or their probes; return False if one is not there any more."""
        tree = ast.parse((ROOT / file).read_text())
        sites, rows = list(_sites(tree)), list(rows)
        found = [number for number, row in rows if row["change"] in (each.change for each in sites[row["site"] :][:1])]
        for number, row in rows:
            site = sites[row["site"]] if number in found else None
            if site is not None and probes:
                site.probe(number)
            elif site is not None:
                site.put(site.new)
        path = self._root / file
        path.write_text(ast.unparse(ast.fix_missing_locations(tree)))
        for each in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            each.unlink()
        return len(found) == len(rows)

    def run(self, tests: Sequence[str], *options: str, limit_s: int = 0) -> tuple[int, list[list[Any]]]:
        """Run tests in their order; return pytest's exit status and what the tests noted."""
        self._notes.write_text("")
        (words := self._folder / "tests").write_text("\n".join(tests))
        command = ["nice", "-n", "5", sys.executable, "-m", "pytest", "-q", "-o", "addopts=", "-p", "no:cacheprovider"]
        command += ["-p", "tests.mutants", "-m", "not nightly", f"--basetemp={self._folder}/temporary", *options]
        environment = {
            _NOTES: str(self._notes),
            _LIMIT: str(limit_s),
            "HYPOTHESIS_STORAGE_DIRECTORY": str(self._folder),
        }
        environment["PYTHONPATH"] = f"{self._root}{os.pathsep}{self._root / 'scripts'}"
        with (
            open(f"{self._folder}/output", "w", encoding="utf-8") as out,
            subprocess.Popen(
                [*command, f"@{words}"], cwd=self._root, env=os.environ | environment, stdout=out, stderr=out,
                start_new_session=True,
            ) as process,
        ):  # fmt: skip
            try:
                status = process.wait()
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
        return status, [json.loads(line) for line in self._notes.read_text().splitlines()]

    def learn(self, rows: Sequence[Row], stage: str, known: Row, workers: int) -> None:
        """Run the test files of a stage that are new or changed, and note which test reaches which living mutant."""
        digests = {
            str(file.relative_to(ROOT)): hashlib.sha256(file.read_bytes()).hexdigest()
            for folder in {each for row in rows if _is_open(row) for each in _folders(stage, row)}
            for file in (ROOT / folder).rglob("test_*.py")
        }
        changed = sorted(name for name, digest in digests.items() if known["files"].get(name) != digest)
        if not changed:
            return
        living = [(number, row) for number, row in enumerate(rows) if _is_open(row)]
        for file in {row["file"] for _, row in living}:
            self.write(file, [each for each in living if each[1]["file"] == file], probes=True)
        _, notes = self.run(changed, "-n", str(workers))
        print(f"{len(changed)} test files: {(self._folder / 'output').read_text().splitlines()[-1]}", flush=True)
        for file in {row["file"] for _, row in living}:
            self.write(file)
        kept = {test: passed_s for test, passed_s in known["tests"].items() if test.partition("::")[0] not in changed}
        known["tests"] = kept | {test: value for test, value in notes if isinstance(test, str) and value >= 0}
        for number, test in (note for note in notes if isinstance(note[0], int)):
            known["reached"].setdefault(str(number), {})[test] = 1
        known["files"] |= digests

    def judge(self, number: int, row: Row, stage: str, known: Row) -> None:
        """Note the test of a stage that kills a mutant, and the seconds."""
        began, seconds = time.monotonic(), known["tests"]
        row["gone"] = not self.write(row["file"], [(0, row)])
        reached = known["reached"].get(str(number), ())
        mirror = "tests/{}/test_{}".format(*row["file"].rsplit("/", 1))
        earlier = tuple(each for other in STAGES[: STAGES.index(stage)] for each in _folders(other, row))
        tests = [test for test in (seconds if "" in reached else reached) if test in seconds]
        tests = [test for test in tests if test.startswith(_folders(stage, row)) and not test.startswith(earlier)]
        tests.sort(key=lambda test: (not test.startswith(mirror), seconds[test]))
        if tests and not row["gone"]:
            status, notes = self.run(tests, "-x", limit_s=int(30 + 10 * max(seconds[test] for test in tests)))
            passed = [test for test, value in notes if isinstance(test, str) and value >= 0]
            failed = [test for test, value in notes if isinstance(test, str) and value < 0]
            if status:
                row |= {"stage": stage, "killed_by": failed[0] if failed else f"{tests[len(passed)]} (time)"}
                row["killed_by"] = row["killed_by"] if passed or failed or status < 0 else "import"
        row["seconds"] = round(row.get("seconds", 0.0) + time.monotonic() - began, 1)
        self.write(row["file"])


def _folders(stage: str, row: Row) -> tuple[str, ...]:
    own = next(f"tests/{package}" for package in PACKAGES if row["file"].startswith(package))
    return {"own": (own,), "golden": ("tests/golden",), "others": _LANE}[stage]


def _is_open(row: Row) -> bool:
    return not (row.get("killed_by") or row.get("equivalent") or row.get("gone"))


def main() -> int:
    """Judge mutants, and print a line for each and a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60, help="mutants (60)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (1)")
    parser.add_argument("--list", action="store_true", help="print the draw, and judge nothing")
    parser.add_argument("--workers", type=int, default=2, help="processes of the first run (2)")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    out = ROOT / ".ci/out" / f"mutants-{options.seed}.jsonl"
    out.parent.mkdir(parents=True, exist_ok=True)
    reach = out.with_suffix(".reached.json")
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    rows = rows or drawn(options.count, options.seed)
    if options.list:
        print("\n".join(f"{row['file']}:{row['line']} {row['change']}" for row in rows))
        return 0
    known = json.loads(reach.read_text()) if reach.exists() else {"files": {}, "tests": {}, "reached": {}}
    with tempfile.TemporaryDirectory(prefix="gdp-mutants-") as folder:
        tree = _Tree(Path(folder))
        for stage in STAGES:
            tree.learn(rows, stage, known, options.workers)
            reach.write_text(json.dumps(known))
            for number, row in enumerate(rows):
                if _is_open(row):
                    tree.judge(number, row, stage, known)
                    out.write_text("".join(json.dumps(each) + "\n" for each in rows))
                    print(
                        f"{number + 1:3} {row['file']}:{row['line']} {row['change'][:90]}: {_verdict(row)}", flush=True
                    )
    stages = [row.get("stage") or _verdict(row) for row in rows]
    print("\n".join(f"{count:4} {stage}" for stage, count in Counter(stages).most_common()))
    return 1 if "lives" in stages else 0


def _verdict(row: Row) -> str:
    return row.get("killed_by") or ("equivalent" if row.get("equivalent") else "gone" if row["gone"] else "lives")


if __name__ == "__main__":
    sys.exit(main())
