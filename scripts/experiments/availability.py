"""Availability of a pool of spot machines, by replaying recorded preemptions.

Command: reads ``scripts/data/spot``, prints a table, writes ``docs/experiments/availability.{md,png,json}``.

    python scripts/experiments/availability.py                      # everything, about 15 seconds
    python scripts/experiments/availability.py --json --quick
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from experiment import Report, Rows, command_line, run_experiment
from machine import data_folder
from plot import COLOURS, pyplot, save, tidy
from skeleton import Options
from spot_trace import Share, Trace, none_up, outages, pool_down, replica_down, share_with_interval

from fog.catalog.measured import measured
from fog.plan.duration import duration_text, seconds_from_text

RECOVERIES: Final = ("34s", "5min", "20min")
BLOCK_S, RESAMPLES, MOST_REPLICAS, SEED = 6 * 3600.0, 2000, 3, 1
_HEAD: Final = ("way", "zones", "replicas", "recovery", "none up", "95 % interval", "if independent")
WAYS: Final = {
    "stays": "each replica has a zone of its own and waits for it",
    "moves": "a replica that is taken is replaced in any of the zones that has capacity",
    "elsewhere": "there is always capacity somewhere: down for the recovery only",
}


@dataclass(frozen=True, slots=True)
class Case:
    """Replay of one pool.

    ``way``: of ``WAYS``. ``none_up``: share of time. ``independent``: product of the single replicas' shares; None
    where they have no share each.
    """

    way: str
    zones: str
    replicas: int
    recovery_s: float
    none_up: Share
    independent: float | None


def main(words: Sequence[str] | None = None) -> None:
    """Compute the share of time in which no replica would have been up."""
    run_experiment(command_line(__doc__), measure, words)


def measure(options: Options) -> Report:
    """Replay every pool with every recovery time; ``--quick``: with the first one."""
    traces, chance = recorded(), np.random.default_rng(SEED)
    spans = [seconds_from_text(text) for text in RECOVERIES[: 1 if options.quick else None]]
    cases = [case for recovery_s in spans for case in replay(traces, recovery_s, chance)]
    return Report(
        "availability",
        {"source": measured().source, "seed": SEED, "cases": [asdict(case) for case in cases]},
        {"table": Rows(_HEAD, [_cells(case) for case in cases], words=2, numbers=5)},
        lambda path, _: _draw(path, cases),
        _figures(),
    )


def recorded() -> list[Trace]:
    """Read the traces. Raises ``RefusedError``: they are missing."""
    paths = sorted(data_folder("spot", ["aws_*.json"]).glob("aws_*.json"))
    return [Trace.from_document(path.stem[-1], json.loads(path.read_text())) for path in paths]


def replay(traces: Sequence[Trace], recovery_s: float, chance: np.random.Generator) -> Iterator[Case]:
    """Yield every pool with that recovery: zones, replicas, way."""
    block = int(BLOCK_S / traces[0].step_s)
    for way, down in (("stays", replica_down), ("elsewhere", outages)):
        each = {trace.zone: down(trace, recovery_s) for trace in traces}
        for count in range(1, len(traces) + 1):
            for zones in itertools.combinations(each, count):
                steps = none_up([each[zone] for zone in zones])
                share = share_with_interval(steps, block, RESAMPLES, chance)
                product = math.prod(float(each[zone].mean()) for zone in zones)
                yield Case(way, "".join(zones), count, recovery_s, share, product)
    for count in range(1, MOST_REPLICAS + 1):
        steps = pool_down(traces, count, recovery_s)
        share = share_with_interval(steps, block, RESAMPLES, chance)
        yield Case("moves", "".join(trace.zone for trace in traces), count, recovery_s, share, None)


def _figures() -> dict[str, object]:
    seen = measured()
    low, high = seen.factors
    return {
        "source": seen.source,
        "taken": ", ".join(f"{zone} {share:.0%}" for zone, share in seen.taken_share.items()),
        "uptime": duration_text(round(seen.uptime_s)),
        "ways": "\n".join(f"- *{way}*: {what}." for way, what in WAYS.items()),
        "block": duration_text(BLOCK_S),
        "resamples": RESAMPLES,
        "low": low,
        "high": high,
    }


def _cells(case: Case) -> tuple[str, ...]:
    share = case.none_up
    return (
        case.way,
        case.zones,
        str(case.replicas),
        duration_text(case.recovery_s),
        f"{share.share:.3%}",
        f"{share.low:.2%} to {share.high:.2%}",
        "-" if case.independent is None else f"{case.independent:.3%}",
    )


def _draw(path: Path, cases: Sequence[Case]) -> None:
    figure, axes = pyplot().subplots(1, len(WAYS), figsize=(11, 3.8), layout="constrained")
    for axis, way in zip(axes, WAYS, strict=True):
        for at, recovery_s in enumerate(dict.fromkeys(case.recovery_s for case in cases)):
            colour = COLOURS[1 + at % 4]
            mine = [case for case in cases if case.way == way and case.recovery_s == recovery_s]
            places = [case.replicas + (at - 1) * 0.12 for case in mine]
            shares = [case.none_up.share for case in mine]
            below = [case.none_up.share - min(case.none_up.low, case.none_up.share) for case in mine]
            upstream = [max(case.none_up.high, case.none_up.share) - case.none_up.share for case in mine]
            label = f"recovery {duration_text(recovery_s)}"
            axis.errorbar(places, shares, yerr=[below, upstream], fmt="o", ms=4, lw=0.8, color=colour, label=label)
            alone = [case.independent for case in mine]
            axis.plot(places, [float("nan") if each is None else each for each in alone], "_", ms=11, color=colour)
        axis.set_title(way, loc="left", fontsize=10)
        axis.set_xticks(range(1, MOST_REPLICAS + 1))
        axis.set_xlabel("replicas", fontsize=8)
        axis.yaxis.set_major_formatter(lambda share, _: f"{share:.0%}")
        axis.set_ylim(bottom=0)
        tidy(axis, has_legend=way == list(WAYS)[-1])
    axes[0].set_ylabel("share of time with none up")
    dots = "dots: replayed, with 95 % interval, one for each choice of zones; dashes: if zones were independent"
    save(figure, path, footer=dots)


if __name__ == "__main__":
    main()
