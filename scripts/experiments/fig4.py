"""Figure 4: bytes on the robot's uplink, with a request to each replica, a dedicated gateway, a replica as gateway.

sudo .venv/bin/python scripts/experiments/fig4.py                  # writes docs/experiments/fig4.*
sudo .venv/bin/python scripts/experiments/fig4.py --quick          # few requests: does it work?
sudo .venv/bin/python scripts/experiments/fig4.py --replicas 3
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from asking import Asking
from experiment import Finding, Report, command_line, run_experiment
from samples import Sample, Series
from skeleton import Options
from tag_cluster import SERVICE, TagCluster

from fog_demo.cluster import DEDICATED, REPLICA

REQUESTS, QUICK = 100, 10
DIRECT: Final = "direct"
FORMS: Final = {DIRECT: DEDICATED, "dedicated gateway": DEDICATED, "replica as gateway": REPLICA}
COUNTED: Final = ("bytes a request from the robot", "bytes a request to the robot", "bytes a request at all replicas")
_PATIENCE_S: Final = 10.0
_WARM_UP: Final = 1  # counted: it has the size of the others
_EXTRA_SHARE: Final = 0.2  # accepted: a copy of its own to a replica that is too slow for the tree
_SETTING: Final = (
    "A robot sends frames of 640 x 480 bytes, one after the other, to a service that finds an AprilTag's pose. The"
    " service has replicas, on machines of `fog`'s provider `local`. *Direct*: each replica is a service of its own,"
    " and the robot calls each one. *Dedicated gateway* and *replica as gateway*: the robot makes one call, and the"
    " gateway's switch copies it (`fog launch --gateway dedicated`, `--gateway replica`).",
    "Bytes are those of Ethernet frames, counted by the kernel where they arrive. They include all control traffic of"
    " that time. A request of *direct* is a call to each replica.",
)
_NOTES: Final = (
    "The paper draws both gateways, and says that they spare the uplink; it has no figures of them.",
    "One copy crosses the uplink where the path to each replica carries a request as fast as the fastest one does."
    " Otherwise the slower replica gets a copy of its own (docs/explanation/congestion-control.md, Requests). So the"
    " shares are above one over the number of replicas, and more so on a busy host.",
    "Latencies of *direct* are of one call each. A robot that calls each replica must also choose among the answers."
    " Its frames pass a dedicated gateway, too, which then copies nothing.",
)


def measure(options: Options) -> Report:
    """Send the same requests in each form."""
    count = QUICK if options.quick else options.requests
    found = {form: _ask(form, options.replicas, count) for form in FORMS}
    figures = {form: of for form, (_, of) in found.items()}
    findings = [Finding(f"{form}: {COUNTED[at]}", each) for form, of in figures.items() for at, each in enumerate(of)]
    one, most = f"1/{options.replicas}", (1 + _EXTRA_SHARE) / options.replicas
    for form in list(FORMS)[1:]:
        share = figures[form][0] / figures[DIRECT][0]
        findings.append(Finding(f"{form}: share of direct, from the robot", share, most, True, one))
    return Report(
        "fig4",
        "Figure 4: bytes on the robot's uplink",
        _SETTING,
        {form: samples for form, (samples, _) in found.items()},
        findings,
        _NOTES,
        {"replicas": options.replicas, "requests": count},
        lambda path, title: _draw(path, title, figures),
    )


def _ask(form: str, replicas: int, count: int) -> tuple[list[Sample], list[float]]:
    """Return the calls of a form, and its figures as in ``COUNTED``."""
    services = tuple(f"{SERVICE}{number + 1}" for number in range(replicas)) if form == DIRECT else (SERVICE,)
    with TagCluster(services, replicas // len(services), FORMS[form], _PATIENCE_S) as cluster:
        for number in (_WARM_UP, count):  # the first series sets up the paths
            before = cluster.received_bytes()
            series = Series("tag", services, number * len(services), (), _PATIENCE_S, warm_up=_WARM_UP * len(services))
            with Asking(cluster, series) as asking:
                samples = list(asking)
            after = cluster.received_bytes()
    return samples, [(now - then) / (count + _WARM_UP) for then, now in zip(before, after, strict=True)]


def _draw(path: Path, title: str, figures: Mapping[str, Sequence[float]]) -> None:
    from pictures import plt, save, tidy

    figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
    for at, (what, colour) in enumerate(zip(COUNTED, ("#1f6f8b", "#c96f3b", "#99a8b2"), strict=True)):
        places = [place + 0.25 * at for place in range(len(figures))]
        axis.barh(places, [each[at] / 1e3 for each in figures.values()], 0.22, color=colour, label=what)
    axis.set_yticks(range(len(figures)), list(figures), fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("kB a request", fontsize=8)
    tidy(axis)
    axis.legend(fontsize=8, frameon=False, ncols=len(COUNTED), loc="lower left", bbox_to_anchor=(0, 1))
    save(figure, path, title)


if __name__ == "__main__":
    parser = command_line(__doc__)
    parser.add_argument("--requests", type=int, default=REQUESTS, help="of each form (default: %(default)s)")
    parser.add_argument("--replicas", type=int, choices=range(2, 9), default=2, help="(default: %(default)s)")
    run_experiment(parser, measure)
