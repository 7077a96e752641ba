"""Cost of security: this tree compared with an earlier commit, in turn, round by round.

ends         processor time to seal and sign a message, to open and verify it, in 100 and 10,000 bytes; advertisements
             that one RIB takes in a second (``security_cost_endpoint.py``): the best of many short blocks, in turn
forwarding   one switch in namespaces: frames a second of the plane ``kernel``, flat out, and processor time of a frame
             at the plane ``raw``, at a steady rate
messages     ``bundles.py`` of each tree: real processes over three switches, 20 reliable topics, 100 bytes, with
             as many messages as are confirmed; with bundles, and with one seal a message
trips        ``messages.py`` of each tree, on the plane ``raw``: a message there and a small answer back

The other commit is checked out in a ``git worktree``, and removed after. Its packages run under scripts of the commit
``SCRIPTS``, the last one whose scripts use the names of that time. So renames in this tree do not disturb it. Target:
no median is worse by more than 5 %. A ratio is taken in each round, since what slows a round slows both.

    sudo .venv/bin/python scripts/bench/security.py cost
    .venv/bin/python scripts/bench/security.py cost --part ends --rounds 9      # no root
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from baselines import Plane
from bundles import BUNDLES, CPU, OVERLOAD, RATE, SINGLE
from chains import ROLES, Chain
from machine import machine_state, thread_s
from peers.figures import MEDIAN
from peers.process import FailedError
from report import Rounds, Target, progress, show

from gdp.host.run_registry import RunRegistry

__all__ = ["add_arguments", "run"]

BASE: Final = "49da3d8"  # the last commit before the work on security
SCRIPTS: Final = "83dca9c"  # the last commit whose scripts import the packages of BASE by their names
HERE: Final = "this tree"
BEFORE: Final = "before"
ASKED: Final = 0.05
SIZES: Final = (128, 1_400)
_TREE: Final = Path(__file__).resolve().parents[2]
_BENCH: Final = _TREE / "scripts" / "bench"
_BASE_CASES: Final = (
    "overload",
    ("bundles", "one seal a message"),
    ("messages/s", "sender, CPU us/message", "reader, CPU us/message"),
)
_BLOCKS: Final = 40  # blocks of 100 messages, at each tree in turn
_BLOCKS_SLOW: Final = 8
_STEADY_HZ: Final = 20_000.0
_TRY_S: Final = 0.5
_TRIES: Final = 3
_PATIENCE_S: Final = 300.0

Figures = dict[tuple[str, str], float]  # figures by case and column; columns of rates end with "/s"


@dataclass(frozen=True, slots=True)
class Tree:
    """Packages of one commit, and the scripts that fit them.

    Attributes:
        endpoint: measures what a message and an advertisement cost.
        roles: the processes of ``_forwarding``.
        cases: of ``bundles.py``: the case, the rows, the columns.
    """

    path: Path
    endpoint: Path
    roles: Path
    cases: tuple[str, tuple[str, ...], tuple[str, ...]]


Trees = Mapping[str, Tree]
Part = Callable[[Trees, argparse.Namespace], dict[str, Figures]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--part", action="append", choices=list(PARTS), help="this part only; may be repeated")
    parser.add_argument("--base", default=BASE, help="the commit to compare with (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="of a figure of messages (default: %(default)s)")


def run(options: argparse.Namespace, _: object) -> tuple[dict[str, object], bool]:
    """Measure; return the figures, and whether all costs are within the target."""
    figures: dict[str, object] = {}
    has_met = True
    state = machine_state()
    own = Tree(_TREE, _BENCH / "security_cost_endpoint.py", ROLES, (OVERLOAD, (BUNDLES, SINGLE), (RATE, *CPU)))
    with _checked_out(options.base) as path, _checked_out(SCRIPTS) as scripts:
        bench = scripts / "scripts" / "bench"
        base = Tree(path, bench / "security_cost_end.py", bench / "roles.py", _BASE_CASES)
        for part in options.part or PARTS:
            over = Rounds()
            for number in range(options.rounds):
                progress(f"{part}, round {number + 1} of {options.rounds}")
                turns = [(BEFORE, base), (HERE, own)]
                for who, figures_of in PARTS[part](dict(turns[:: 1 if number % 2 else -1]), options).items():
                    for (case, column), value in figures_of.items():
                        over.add(who, case, column, value)
            targets = _targets(over)
            show(f"Cost of security: {part}", state, {"rounds": options.rounds, BEFORE: options.base}, over, targets)
            has_met = has_met and all(target.met is not False for target in targets)
            figures[part] = {
                BEFORE: options.base,
                "rounds": over.values,
                "ratios": {target.what: str(target.measured) for target in targets},
                "met": {target.what: target.met for target in targets},
            }
    return figures, has_met


def _targets(over: Rounds) -> list[Target]:
    targets = []
    for case in over.cases():
        for column in over.columns(case):
            is_rate = column.endswith("/s")
            asked = 1 - ASKED if is_rate else 1 + ASKED
            what = f"{case}, {column}: {HERE} / {BEFORE}"
            targets.append(over.ratio(what, HERE, BEFORE, case, column, asked, at_most=not is_rate))
    return targets


@contextmanager
def _checked_out(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary work tree; remove it at the end."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(_TREE), "worktree"]
        made = subprocess.run([*git, "add", "--detach", str(tree), commit], capture_output=True, text=True, check=False)
        if made.returncode:
            raise FailedError(f"git worktree add {commit}: {made.stderr.strip()}")
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def _environment(tree: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(tree)}


def _output(tree: Path, *argv: str) -> str:
    """Run a script with the packages of a tree; return what it printed.

    Raises:
        FailedError: it failed.
    """
    done = subprocess.run(
        [sys.executable, *argv],
        env=_environment(tree), cwd=tree, capture_output=True, text=True, timeout=_PATIENCE_S, check=False,
    )  # fmt: skip
    if done.returncode:
        raise FailedError(f"{' '.join(argv)}: {done.stderr[-300:]}")
    return done.stdout


# -- parts


def _ends(trees: Trees, _: argparse.Namespace) -> dict[str, Figures]:
    found: dict[str, Figures] = {who: {} for who in trees}
    with ExitStack() as undo:
        ends = {
            who: undo.enter_context(
                subprocess.Popen(
                    [sys.executable, str(tree.endpoint)], env=_environment(tree.path), text=True,
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                )
            )
            for who, tree in trees.items()
        }  # fmt: skip
        names = [json.loads(_line(end)) for end in ends.values()][-1]  # each prints it, with the same value
        for name in names:
            best = max if name.endswith("/s") else min
            for _block in range(_BLOCKS_SLOW if name.endswith("/s") else _BLOCKS):
                for who, end in ends.items():
                    value, key = float(_line(end, name)), ("ends", name)
                    found[who][key] = best(value, found[who].get(key, value))
        for end in ends.values():
            assert end.stdin is not None
            end.stdin.close()
    return found


def _line(end: subprocess.Popen[str], asked: str | None = None) -> str:
    """Return the next line of a process, after an optional command.

    Raises:
        FailedError: it ended.
    """
    assert end.stdin is not None
    assert end.stdout is not None
    if asked is not None:
        end.stdin.write(asked + "\n")
        end.stdin.flush()
    line = end.stdout.readline()
    if not line:
        raise FailedError("security_cost_endpoint.py ended")
    return line


def _forwarding(tree: Tree, _: argparse.Namespace) -> Figures:
    found: Figures = {}
    runs = RunRegistry()
    runs.sweep()
    with Chain(runs, 1, 1_500) as chain:
        for name in ("kernel", "raw"):
            plane = Plane(name, processes=name == "raw")
            with _packages_of(tree, chain):
                standing = plane.stand(chain)
            with standing:
                for size in SIZES:
                    wire = plane.wire(chain, size)
                    if name == "kernel":
                        tries = [chain.attempt(wire, [], None, _TRY_S) for _ in range(_TRIES)]
                        found[f"one switch, {size:,} B", "kernel: frames/s"] = max(each.rate for each in tries)
                        continue
                    (switch,) = plane.workers()
                    costs = []
                    for _try in range(_TRIES):
                        before_s = thread_s(switch.pid)
                        got = chain.attempt(wire, [], _STEADY_HZ, _TRY_S).got
                        costs.append(1e6 * (thread_s(switch.pid) - before_s) / got)
                    found[f"one switch, {size:,} B", "raw: CPU us/frame"] = min(costs)
    return found


@contextmanager
def _packages_of(tree: Tree, chain: Chain) -> Iterator[None]:
    """Make processes that start meanwhile use the packages of a tree."""
    before, roles = os.environ.get("PYTHONPATH"), chain.roles
    os.environ["PYTHONPATH"], chain.roles = str(tree.path), tree.roles
    try:
        yield
    finally:
        chain.roles = roles
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


def _own_bench(tree: Path, name: str, *argv: str) -> Mapping[str, Mapping[str, Mapping[str, list[float | None]]]]:
    """Run a bench of a tree for one round; return its figures by baseline, case and column."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "figures.json"
        _output(tree, str(tree / "scripts" / "bench" / name), "--rounds", "1", "--json", str(out), *argv)
        found: Mapping[str, Mapping[str, Mapping[str, list[float | None]]]] = json.loads(out.read_text())["rounds"]
        return found


def _messages(tree: Tree, options: argparse.Namespace) -> Figures:
    found = _own_bench(tree.path, "bundles.py", "--no-plot", "--seconds", str(options.seconds))
    figures: Figures = {}
    case, rows, columns = tree.cases
    for who, row in zip((BUNDLES, SINGLE), rows, strict=True):
        for column, name in zip((RATE, *CPU), columns, strict=True):
            value = found[row][case][name][0]
            if value is None:
                raise FailedError(f"bundles.py of {tree.path} has no {name}")
            figures[f"100 B, overload, {who}", column] = value
    return figures


def _trips(tree: Tree, _: argparse.Namespace) -> Figures:
    sizes = [word for size in (100, 10_000) for word in ("--size", str(size))]
    cut = ["--only", "gdp-raw", "--mtu", "1500", "--offloads", "off", "--encoding", "cdr", "--count", "100"]
    found = _own_bench(tree.path, "messages.py", *cut, *sizes)
    figures: Figures = {}
    for cases in found.values():
        for case, columns in cases.items():
            (value,) = columns[MEDIAN]
            if value is None:
                raise FailedError(f"messages.py of {tree.path} has no {MEDIAN} of {case}")
            figures[case, MEDIAN] = value
    return figures


def _one_by_one(measure: Callable[[Tree, argparse.Namespace], Figures]) -> Part:
    return lambda trees, options: {who: measure(tree, options) for who, tree in trees.items()}


PARTS: Final[Mapping[str, Part]] = {
    "ends": _ends,
    "forwarding": _one_by_one(_forwarding),
    "messages": _one_by_one(_messages),
    "trips": _one_by_one(_trips),
}
