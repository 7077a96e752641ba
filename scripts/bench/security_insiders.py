"""Insider bench: hostile statements of real members, and how many of them ended a process.

Whole networks in memory (``tests/insiders``) receive statements of every type, signed with the keys of eleven hostile
members. A random journey has brought each network into its state. An error that leaves a machine would end its process;
the boundary that a node has around each frame counts it. Both count here. Broken invariants count too: bytes drawn by
an untrusted sender, bounds of tables, the flow on which no insider has a right.

Runs add up in the file; each begins at the seed after the last one. ``scripts/fuzz.py insiders --shrink`` reduces the
findings.

    .venv/bin/python scripts/bench/security.py insiders --seconds 400 --processes 2
    .venv/bin/python scripts/bench/security.py insiders --statements 20000 --seed 7 --no-save
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import Any, Final

from report import progress

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.insiders.search import Search, searched

__all__ = ["add_arguments", "run"]

GOAL_STATEMENTS: Final = 10_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this subcommand."""
    parser.add_argument("--statements", type=int, default=GOAL_STATEMENTS, help="in this run (default: %(default)s)")
    parser.add_argument("--seconds", type=float, help="end after so long in any case")
    parser.add_argument("--processes", type=int, default=1, help="side by side (default: 1)")
    parser.add_argument("--seed", type=int, help="of the first trial (default: the one after the last in the file)")


def run(options: argparse.Namespace, before: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Try statements, and add the results to the file."""
    logging.disable(logging.CRITICAL)
    runs: list[list[int]] = before.get("seeds", [])
    seed = options.seed or (runs[-1][1] + 1 if runs else 1)
    search = Search()
    for search in searched(options.statements, options.processes, seed, options.seconds):
        progress(f"{search.statements} statements, {len(search.found)} findings")
    for place, found in search.found.items():
        progress(f"FOUND {place}\n  at: {found.at}, seed {found.plan.seed}\n  {found.text.strip()}")
    figures = {
        "target_statements": GOAL_STATEMENTS,
        "statements": search.statements + before.get("statements", 0),
        "trials": search.trials + before.get("trials", 0),
        "exceptions": search.exceptions + before.get("exceptions", 0),
        "broken": search.broken + before.get("broken", 0),
        "processor_s": round(search.seconds * options.processes + before.get("processor_s", 0.0)),
        "seeds": [*runs, [seed, seed + search.trials - 1]],
        "found": before.get("found", []) + [f"seed {each.plan.seed}: {place}" for place, each in search.found.items()],
    }
    progress(
        f"{search.statements} statements, {search.statements / max(search.seconds, 1e-9):.0f}/s;"
        f" {figures['statements']} in all, {figures['exceptions']} exceptions, {figures['broken']} invariants broken"
    )
    has_met = figures["statements"] >= GOAL_STATEMENTS and not figures["exceptions"] and not figures["broken"]
    return figures, has_met
