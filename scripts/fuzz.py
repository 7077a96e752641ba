#!/usr/bin/env python3
"""Give every decoder mutated inputs; each must return or raise one of its own errors.

Examples:
  scripts/fuzz.py --list                             the decoders, and what they may raise
  scripts/fuzz.py --seconds 5                        all decoders, five seconds each
  scripts/fuzz.py --only msg,idl --seconds 60        two of them, a minute each
  scripts/fuzz.py --only mcap --seed 7 --keep        other inputs; new ones go to tests/corpus/mcap/
  scripts/fuzz.py --only frame --input crash.bin     one input, with the whole traceback of what it raises

The table shows executions, those that were refused, foreign exceptions, the slowest execution (processor time) and the
largest memory over the length of an input. Exit status: 0, or 1 where there was a foreign exception, or 2 for a wrong
option.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.fuzzing.decoder import Decoder
from tests.fuzzing.registry import DECODERS
from tests.fuzzing.runner import Outcome, corpus_of, fuzz, keep

_COLUMNS = (
    f"{'decoder':<15} {'executions':>10} {'refused':>8} {'foreign':>8}"
    f" {'slowest ms':>11} {'memory x':>9} {'new':>5}"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz what the arguments say, and return the exit status."""
    options = _parsed(arguments)
    logging.disable(logging.CRITICAL)
    by_name = {decoder.name: decoder for decoder in DECODERS}
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
    if options.input is not None:
        return _one(decoders, options.input)
    outcomes = []
    print(_COLUMNS)
    for decoder in decoders:
        outcomes.append(fuzz(decoder, options.seconds, options.seed))
        _show(outcomes[-1])
        if options.keep:
            keep(outcomes[-1])
    return _findings(outcomes)


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="for each decoder (default: 2)")
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
    print(f"\n{total} executions of {len(outcomes)} decoders, {foreign} with a foreign exception")
    for outcome in outcomes:
        for place, finding in outcome.findings.items():
            shown = finding.data[:60].hex() + ("..." if len(finding.data) > 60 else "")
            print(f"{outcome.decoder.name}: {place}: {finding.error}\n    {len(finding.data)} bytes: {shown}")
    return 1 if foreign else 0


if __name__ == "__main__":
    sys.exit(main())
