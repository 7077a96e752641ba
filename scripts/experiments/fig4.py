"""Figure 4: bytes on the robot's uplink, with a request to each replica, a dedicated gateway, a replica as gateway.

sudo .venv/bin/python scripts/experiments/fig4.py                  # writes docs/experiments/fig4.*
sudo .venv/bin/python scripts/experiments/fig4.py --quick          # few requests: does it work?
"""

from __future__ import annotations

from typing import Final

from asking import Asking
from experiment import Finding, Report, command_line, run_experiment
from plot import Bar, Panel, save_bars
from samples import Sample, Series
from skeleton import Options
from tag_cluster import SERVICE, TagCluster

from fog_demo.cluster import DEDICATED, REPLICA

REQUESTS, QUICK = 100, 10
REPLICAS: Final = 2
DIRECT: Final = "direct"
FORMS: Final = {DIRECT: DEDICATED, "dedicated gateway": DEDICATED, "replica as gateway": REPLICA}
COUNTED: Final = ("bytes a request from the robot", "bytes a request to the robot", "bytes a request at all replicas")
_PATIENCE_S: Final = 10.0
_WARM_UP: Final = 1  # counted: it has the size of the others
_EXTRA_SHARE: Final = 0.2  # accepted: a copy of its own to a replica that is too slow for the tree


def measure(options: Options) -> Report:
    """Send the same requests in each form."""
    count = QUICK if options.quick else REQUESTS
    found = {form: _ask(form, count) for form in FORMS}
    figures = {form: of for form, (_, of) in found.items()}
    findings = [Finding(f"{form}: {COUNTED[at]}", each) for form, of in figures.items() for at, each in enumerate(of)]
    panels = [
        Panel(what, "kB a request", [Bar(form, of[at] / 1e3, ours=form != DIRECT) for form, of in figures.items()])
        for at, what in enumerate(COUNTED)
    ]
    one, most = f"1/{REPLICAS}", (1 + _EXTRA_SHARE) / REPLICAS
    for form in list(FORMS)[1:]:
        share = figures[form][0] / figures[DIRECT][0]
        findings.append(Finding(f"{form}: share of direct, from the robot", share, most, True, one))
    return Report.of(
        "fig4",
        {form: samples for form, (samples, _) in found.items()},
        findings,
        {"replicas": REPLICAS, "requests": count},
        lambda path, title: save_bars(path, title, "", panels),
    )


def _ask(form: str, count: int) -> tuple[list[Sample], list[float]]:
    """Return the calls of a form, and its figures as in ``COUNTED``."""
    services = tuple(f"{SERVICE}{number + 1}" for number in range(REPLICAS)) if form == DIRECT else (SERVICE,)
    with TagCluster(services, REPLICAS // len(services), FORMS[form], _PATIENCE_S) as cluster:
        for number in (_WARM_UP, count):  # the first series sets up the paths
            before = cluster.received_bytes()
            series = Series("tag", services, number * len(services), (), _PATIENCE_S, warm_up=_WARM_UP * len(services))
            with Asking(cluster.client, series) as asking:
                samples = list(asking)
            after = cluster.received_bytes()
    return samples, [(now - then) / (count + _WARM_UP) for then, now in zip(before, after, strict=True)]


if __name__ == "__main__":
    run_experiment(command_line(__doc__), measure)
