"""Figure 7: object detection while the link of one replica takes 100 ms more. One server against two.

sudo .venv/bin/python scripts/experiments/fig7.py                  # writes docs/experiments/fig7.*
sudo .venv/bin/python scripts/experiments/fig7.py --quick          # a few seconds: does it work?
"""

from __future__ import annotations

from typing import Final

from asking import Asking
from experiment import CASES, Finding, Report, command_line, field_of, gains, latencies_of, run_experiment, work_of
from field import Served
from frames import TYPE
from plot import save_distributions
from samples import Sample, Series
from skeleton import Options

DELAY_S: Final = 0.1
REQUESTS: Final = 300
QUICK: Final = 2
_TAKES_S: Final = 0.01
_GAP_S: Final = 0.1  # between the end of a request and the next one, at least so long after the one before began
_PATIENCE_S: Final = 10.0
# Both readings of "+100 ms": the round trip takes 100 ms more, or each way does.
_LINKS: Final = {"m2": ("round trip +100 ms", DELAY_S / 2), "m3": ("each way +100 ms", DELAY_S)}
_NEAR: Final = "m1"


def measure(options: Options) -> Report:
    """Detect objects while one replica's link is slow: one server against two replicas."""
    count = QUICK if options.quick else REQUESTS
    machines = (_NEAR, *_LINKS)
    served = [Served(f"/detect/{each}", TYPE, (each,)) for each in machines]
    served += [Served(f"/detect/both/{each}", TYPE, (_NEAR, each)) for each in _LINKS]
    work = work_of(served, "count", {each: {"takes_s": [_TAKES_S]} for each in machines})
    turns = tuple(
        name
        for each in _LINKS
        for name in (f"/detect/{_NEAR}", f"/detect/both/{each}", f"/detect/{each}", f"/detect/both/{each}")
    )
    calls, warm_up = 2 * len(_LINKS) * count, 2 * len(turns)
    series = Series("count", turns, calls, machines, _PATIENCE_S, gap_s=_GAP_S, warm_up=warm_up)
    delays = {each: delay_s for each, (_, delay_s) in _LINKS.items()}
    with field_of(served, work, delays) as here, Asking(here.client, series) as asking:
        found, plane = asking.by_service("requests"), here.data_plane
    groups, findings = _compared(found)
    panels = latencies_of(groups, "{case}, {name}", [link for link, _ in _LINKS.values()], 1e3)
    return Report.of(
        "fig7",
        groups,
        findings,
        {"requests of each case": count, "servers": "wait", "switches": plane},
        lambda path, title: save_distributions(path, title, panels, "latency, ms"),
        {
            "delay_ms": 1e3 * DELAY_S,
            "mean_ms": 1e3 * DELAY_S / 2.2,
            "p99_ms": 1e3 * DELAY_S / 2.9,
            "twice_ms": 2e3 * DELAY_S,
            "takes_ms": 1e3 * _TAKES_S,
        },
    )


def _compared(found: dict[str, list[Sample]]) -> tuple[dict[str, list[Sample]], list[Finding]]:
    """Return the cases, and the gains. The near machine's requests are shared out between the links in turn."""
    groups: dict[str, list[Sample]] = {}
    findings: list[Finding] = []
    near = found[f"/detect/{_NEAR}"]
    for at, (machine, (link, _)) in enumerate(_LINKS.items()):
        one = near[at :: len(_LINKS)] + found[f"/detect/{machine}"]
        two = found[f"/detect/both/{machine}"]
        groups |= {f"{case}, {link}": samples for case, samples in zip(CASES, (one, two), strict=True)}
        findings += gains(f"{{}} gain, {link}", one, two, ("2.1", "3.9 (2.0 in the abstract)"), (2.1, 3.9))
    return groups, findings


if __name__ == "__main__":
    run_experiment(command_line(__doc__), measure)
