"""Figure 6: segmentation while a second client contends for one replica. One server against two.

sudo .venv/bin/python scripts/experiments/fig6.py                  # writes docs/experiments/fig6.*
sudo .venv/bin/python scripts/experiments/fig6.py --quick          # a few seconds: does it work?
sudo .venv/bin/python scripts/experiments/fig6.py --quick --compute    # the same, and the networks run
"""

from __future__ import annotations

import random
from contextlib import nullcontext
from dataclasses import dataclass
from statistics import median
from typing import Final

from asking import Asking
from experiment import CASES, Finding, Report, command_line, field_of, gains, latencies_of, run_experiment, work_of
from field import Served
from frames import TYPE
from plot import save_distributions
from recorded import draw, segmentation_runs
from samples import Sample, Series, least_of_two, p99
from skeleton import Options
from vision import require_network

REQUESTS: Final = 300
COMPUTED: Final = 100
QUICK: Final = 2
ON_S: Final = 1.1
OFF_S: Final = 1.0
_GAP_S: Final = 0.27  # longer than a wait, so that the slower replica is done; not in step with the second client
_PATIENCE_S: Final = 10.0
_MACHINES: Final = ("m1", "m2")
_ONE, _TWO = "/segment/m1", "/segment"
_SEED: Final = 6
_WAIT, _COMPUTE = "count", "segment"  # role of the servers, and task of their clients
_RUNS: Final = segmentation_runs()
_OFFLINE: Final = p99(_RUNS) / p99(least_of_two(_RUNS))
_P50_MS, _P99_MS = 1e3 * median(_RUNS), 1e3 * p99(_RUNS)


@dataclass(frozen=True, slots=True)
class _Setting:
    """Role of the servers, presence of the second client, and the paper's gains of mean and p99."""

    role: str
    is_contended: bool
    paper: tuple[str, str] = ("", "")


_SETTINGS: Final = {
    "servers wait, no contention": _Setting(_WAIT, False, ("", "1.3")),
    "servers wait, contended": _Setting(_WAIT, True, ("1.31", "1.96 (2.1 in the abstract)")),
    "servers compute, no contention": _Setting(_COMPUTE, False, ("", "1.3")),
    "servers compute, contended": _Setting(_COMPUTE, True, ("1.31", "1.96 (2.1 in the abstract)")),
}


def measure(options: Options) -> Report:
    """Segment frames while a second client contends for one replica."""
    wanted = {_WAIT: REQUESTS, _COMPUTE: options.computed}
    wanted = {_WAIT: QUICK, _COMPUTE: QUICK * options.compute} if options.quick else wanted
    if wanted[_COMPUTE]:
        require_network()
    chosen = [what for what, each in _SETTINGS.items() if each.is_contended or not options.quick]
    counts = {what: count for what in chosen if (count := wanted[_SETTINGS[what].role])}
    served = [Served(_TWO, TYPE, _MACHINES), Served(_ONE, TYPE, _MACHINES[:1])]
    groups: dict[str, list[Sample]] = {}
    findings: list[Finding] = []
    for what, count in counts.items():
        setting = _SETTINGS[what]
        series = Series(setting.role, (_ONE, _TWO), 2 * count, _MACHINES, _PATIENCE_S, gap_s=_GAP_S)
        work = work_of(served, setting.role, {each: {"takes_s": times} for each, times in _times().items()})
        with field_of(served, work) as here:
            contention = {"task": setting.role, "service": _ONE, "on_s": ON_S, "off_s": OFF_S}
            conflict = here.client(_MACHINES[0], "busy", **contention) if setting.is_contended else nullcontext()
            with conflict, Asking(here.client, series) as asking:
                found, plane = asking.by_service(what), here.data_plane
        groups |= {f"{what}, {case}": found[name] for case, name in zip(CASES, (_ONE, _TWO), strict=True)}
        findings += gains(f"{{}} gain, {what}", found[_ONE], found[_TWO], setting.paper)
    findings.append(Finding("p99 gain offline, least of any two recorded runs", _OFFLINE, paper="1.3"))
    panels = latencies_of(groups, "{name}, {case}", counts, 1e3)
    return Report.of(
        "fig6",
        groups,
        findings,
        {"requests of each case": ", ".join(map(str, counts.values())), "switches": plane},
        lambda path, title: save_distributions(path, title, panels, "latency, ms"),
        {"on_s": ON_S, "off_s": OFF_S, "runs": len(_RUNS), "p50_ms": _P50_MS, "p99_ms": _P99_MS, "offline": _OFFLINE},
    )


def _times() -> dict[str, list[float]]:
    """Return the seconds of each machine's requests, one after the other."""
    chance = random.Random(_SEED)
    return {each: draw(_RUNS, 1.0, REQUESTS, chance) for each in _MACHINES}


if __name__ == "__main__":
    parser = command_line(__doc__)
    parser.add_argument("--computed", type=int, default=COMPUTED, help="while they compute (default: %(default)s)")
    parser.add_argument("--compute", action="store_true", help="with --quick: let servers compute, too")
    run_experiment(parser, measure)
