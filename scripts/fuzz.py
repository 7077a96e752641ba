#!/usr/bin/env python3
"""Fuzzing: every decoder gets mutated inputs and must return or raise one of its own errors, in time and memory.

Examples:
  scripts/fuzz.py --list                             the decoders, and what they may raise
  scripts/fuzz.py --seconds 5                        all decoders, five seconds each
  scripts/fuzz.py --guided --total 60                guided by branches (atheris), a minute for all of them
  scripts/fuzz.py --only msg,idl --seconds 60        two of them, a minute each
  scripts/fuzz.py --only mcap --seed 7 --keep        other inputs; new ones go to tests/corpus/mcap/
  scripts/fuzz.py --only frame --input crash.bin     one input, with the whole traceback of what it raises
  scripts/fuzz.py minimise                           delete kept inputs that run nothing of their own
  scripts/fuzz.py insiders --statements 10000000     hostile statements of real members, to whole networks in memory

The table shows executions, those that were refused, foreign exceptions, the slowest execution (processor time) and the
largest memory over the length of an input. Exit status: 0, or 1 where there was a finding, or 2 for a wrong option.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.fuzzing.decoder import Decoder
from tests.fuzzing.runner import Outcome, corpus_of, fuzz, keep, minimise

if TYPE_CHECKING:
    from tests.insiders.trial import Plan

_COLUMNS = (
    f"{'decoder':<15} {'executions':>10} {'refused':>8} {'foreign':>8} {'slowest ms':>11} {'memory x':>9} {'new':>5}"
)
_Fuzz = Callable[[Decoder, float, int], Outcome]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the fuzzing that the arguments select, and return the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["insiders"]:
        return _insiders(given[1:])
    is_minimise = given[:1] == ["minimise"]
    options = _parsed(given[is_minimise:])
    logging.disable(logging.CRITICAL)
    every, fuzz_one = _engine(options)
    by_name = {decoder.name: decoder for decoder in every}
    names = options.only.split(",") if options.only else list(by_name)
    if unknown := [name for name in names if name not in by_name]:
        print(f"--only: no decoder is called {', '.join(unknown)} (see --list)", file=sys.stderr)
        return 2
    decoders = [by_name[name] for name in names]
    if options.list:
        for decoder in decoders:
            allowed = ", ".join(error.__name__ for error in decoder.allowed) or "nothing"
            print(f"{decoder.name:<15} {len(corpus_of(decoder)):>4} inputs, may raise {allowed}")
        return 0
    if is_minimise:
        gone = [path for decoder in decoders for path in minimise(decoder)]
        print(f"{len(gone)} inputs deleted")
        return 0
    if options.input is not None:
        return _one(decoders, options.input)
    outcomes = []
    seconds = options.seconds if options.total is None else options.total / len(decoders)
    print(_COLUMNS)
    for decoder in decoders:
        outcomes.append(fuzz_one(decoder, seconds, options.seed))
        _show(outcomes[-1])
        if options.keep:
            keep(outcomes[-1])
    return _findings(outcomes)


def _engine(options: argparse.Namespace) -> tuple[Sequence[Decoder], _Fuzz]:
    """Return the decoders, and the engine that fuzzes one of them: libFuzzer where requested and installed."""
    if options.guided:
        from tests.fuzzing.guided import guided, instrumented_decoders

        try:
            return instrumented_decoders(), guided
        except ImportError:
            print("--guided: atheris is not installed here; the inputs are guided by sampled lines", file=sys.stderr)
    from tests.fuzzing.registry import DECODERS

    return DECODERS, fuzz


def _parsed(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="for each decoder (default: 2)")
    parser.add_argument("--total", type=float, metavar="SECONDS", help="for all decoders together")
    parser.add_argument("--guided", action="store_true", help="guided by the branches that run (needs atheris)")
    parser.add_argument("--only", metavar="NAMES", default="", help="decoders, separated by commas")
    parser.add_argument("--seed", type=int, default=1, help="of the mutations (default: 1)")
    parser.add_argument("--list", action="store_true", help="list the decoders and exit")
    parser.add_argument("--keep", action="store_true", help="write new inputs and findings to tests/corpus/")
    parser.add_argument("--input", type=Path, metavar="FILE", help="run this input alone; with --only")
    return parser.parse_args(arguments)


def _one(decoders: Sequence[Decoder], path: Path) -> int:
    for decoder in decoders:
        try:
            decoder.run(path.read_bytes())
        except decoder.allowed as error:
            print(f"{decoder.name}: refused: {type(error).__name__}: {error}")
        else:
            print(f"{decoder.name}: read")
    return 0


def _show(outcome: Outcome) -> None:
    print(
        f"{outcome.decoder.name:<15} {outcome.executions:>10} {outcome.refused:>8} {outcome.foreign:>8}"
        f" {outcome.slowest_ms:>11.1f} {outcome.memory_ratio:>9.1f} {len(outcome.found):>5}",
        flush=True,
    )


def _findings(outcomes: Sequence[Outcome]) -> int:
    total = sum(outcome.executions for outcome in outcomes)
    foreign = sum(outcome.foreign for outcome in outcomes)
    excess = sum(finding.is_excess for outcome in outcomes for finding in outcome.findings.values())
    found = sum(len(outcome.findings) for outcome in outcomes) - excess
    print(f"\n{total} executions of {len(outcomes)} decoders, {foreign} with a foreign exception, {excess} over limits")
    for outcome in outcomes:
        for place, finding in outcome.findings.items():
            shown = finding.data[:60].hex() + ("..." if len(finding.data) > 60 else "")
            print(f"{outcome.decoder.name}: {place}: {finding.error}\n    {len(finding.data)} bytes: {shown}")
    return 1 if found else 0


def _insiders(arguments: Sequence[str]) -> int:
    """Send statements of hostile members to networks in memory."""
    parser = argparse.ArgumentParser(prog="scripts/fuzz.py insiders", description=_insiders.__doc__)
    parser.add_argument("--statements", type=int, default=10_000, metavar="N", help="to try (default: 10000)")
    parser.add_argument("--seconds", type=float, help="end after so long in any case")
    parser.add_argument("--processes", type=int, default=1, help="side by side (default: 1)")
    parser.add_argument("--seed", type=int, default=1, help="of the first trial (default: 1)")
    parser.add_argument("--shrink", type=float, metavar="SECONDS", default=0.0, help="for each finding")
    options = parser.parse_args(arguments)
    logging.disable(logging.CRITICAL)
    from tests.insiders.search import Search, searched
    from tests.insiders.trial import shrunk

    search = Search()
    for search in searched(options.statements, options.processes, options.seed, options.seconds):
        print(f"\r{search.statements} statements, {len(search.found)} findings", end="", file=sys.stderr, flush=True)
    figures = search.figures
    rate = search.statements / max(search.seconds, 1e-9)
    print(f"\n{search.statements} statements in {search.trials} trials, {rate:.0f}/s by {options.processes} processes")
    print(f"{search.exceptions} trials ended by an exception, {search.broken} by an invariant")
    worst = sorted(figures.worst.items(), key=lambda each: each[1], reverse=True)[:8]
    for what, (ratio, drawn, said) in worst:
        mean = figures.drawn[what] / max(figures.said[what], 1)
        print(f"amplification {ratio:6.1f} ({said} bytes drew {drawn}; mean {mean:.2f}): {what}")
    for table, size in figures.tables.most_common(6):
        print(f"table {size:6} {table}")
    slow = sorted(figures.slowest.items(), key=lambda each: each[1], reverse=True)[:6]
    for what, slow_s in slow:
        mean_ms = 1e3 * figures.spent[what] / figures.count[what]
        print(f"time {1e3 * slow_s:6.1f} ms at most (mean {mean_ms:.2f}): {what}")
    for place, found in search.found.items():
        print(f"\nFOUND {place}\n  at: {found.at}\n  {found.text.strip()}")
        if options.shrink:
            print(f"  {shrunk(found.plan, partial(_breaks, place), options.shrink)}")
        else:
            print(f"  again: scripts/fuzz.py insiders --seed {found.plan.seed} --statements 10000 --shrink 600")
    return 1 if search.found else 0


def _breaks(place: str, plan: Plan) -> bool:
    """Return whether a plan fails at this location."""
    from tests.insiders.search import run_plan

    _, found = run_plan(plan)
    return found is not None and found.place == place


if __name__ == "__main__":
    sys.exit(main())
