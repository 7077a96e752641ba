"""Figure 9: pose of a tag, ten times a second, while machines are killed in turn and the supervisor replaces them.

sudo .venv/bin/python scripts/experiments/fig9.py                  # writes docs/experiments/fig9.*
sudo .venv/bin/python scripts/experiments/fig9.py --quick          # a few seconds: does it work?
sudo .venv/bin/python scripts/experiments/fig9.py --minutes 30
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Final

from asking import Asking
from experiment import Finding, Report, command_line, run_experiment
from plot import Span, save_timeline
from report import progress
from samples import Sample, Series, Summary
from skeleton import Options
from tag_cluster import SERVICE, TagCluster

from fog_demo.cluster import DEDICATED

MINUTES: Final = 2.0
MACHINES: Final = 2
QUICK_MINUTES: Final = 0.25
_HZ: Final = 10.0
_STEADY_S: Final = 4.0  # time in which all serve, before the next machine is killed
_LANES: Final = 1_000  # the camera does not wait for answers
_PATIENCE_S: Final = 10.0


class _FaultInjector:
    """Kills the machine that has served for longest, whenever all serve; driven by the answers as they arrive.

    ``spans``: from the death of a machine until its replacement served; the last one may have no end. ``labels``: by
    machine, the name of the first of those that replace each other.
    """

    def __init__(self, cluster: TagCluster) -> None:
        self._cluster = cluster
        self._whole_s = 0.0
        self._killed_unix_s: float | None = None  # None: all serve
        self.spans: list[Span] = []
        self.labels: dict[str, str] = {}

    def see(self, since_s: float) -> None:
        """Kill a machine if it is time, or look whether its replacement serves, ``since_s`` after the beginning."""
        if self._killed_unix_s is not None:
            if (served := self._cluster.replacement(self._killed_unix_s)) is not None:
                self.spans[-1] = span = replace(self.spans[-1], to_s=since_s)
                self.labels[served.name] = span.machine
                progress(f"{served.name} serves {span.to_s - span.from_s:.1f} s after a death")
                self._killed_unix_s, self._whole_s = None, since_s
        elif since_s - self._whole_s >= _STEADY_S:
            lost, self._killed_unix_s = self._cluster.oldest(), time.time()
            self._cluster.kill(lost)
            self.spans.append(Span(self.labels.setdefault(lost.name, lost.name), since_s, math.inf))


def measure(options: Options) -> Report:
    """Find a tag while machines are killed and replaced."""
    count = round((QUICK_MINUTES if options.quick else options.minutes) * 60 * _HZ)
    series = Series(
        "tag", (SERVICE,), count, (), _PATIENCE_S, lanes=_LANES, gap_s=1 / _HZ, warm_up=10, counts_answers=True
    )
    samples: list[Sample] = []
    with TagCluster([SERVICE], MACHINES, DEDICATED, _PATIENCE_S) as cluster, Asking(cluster.client, series) as asking:
        fault_injector = _FaultInjector(cluster)
        for sample in asking:
            samples.append(sample)
            fault_injector.see(time.monotonic() - samples[0].begun_s)
    from_s, labels = samples[0].begun_s, fault_injector.labels
    end_s = max(each.begun_s for each in samples) - from_s
    spans = [replace(each, to_s=min(each.to_s, end_s)) for each in fault_injector.spans]
    drawn = [replace(each, machine=labels.get(each.machine, each.machine)) for each in samples]
    return Report.of(
        "fig9",
        _groups(samples, spans, from_s),
        _findings(samples, asking, spans),
        {"machines": MACHINES, "requests a second": _HZ, "kills": len(spans)},
        lambda path, title: save_timeline(path, title, drawn, spans, from_s),
        {"steady_s": _STEADY_S},
    )


def _groups(samples: list[Sample], spans: list[Span], from_s: float) -> dict[str, list[Sample]]:
    def is_hit(sample: Sample) -> bool:
        return any(span.from_s <= sample.begun_s - from_s < span.to_s for span in spans)

    groups = {
        "all": samples,
        "all machines serve": [each for each in samples if not is_hit(each)],
        "one is away": [each for each in samples if is_hit(each)],
    }
    return {name: each for name, each in groups.items() if each}


def _findings(samples: list[Sample], asking: Asking, spans: list[Span]) -> list[Finding]:
    found, away_s = Summary.of(samples), [each.to_s - each.from_s for each in spans]
    return [
        Finding("requests", found.count),
        Finding("kills", len(spans)),
        Finding("failed requests", found.failed, 0, at_most=True, paper="0"),
        Finding("answers too many", asking.twice or 0, 0, at_most=True),
        Finding("answers that reached a call", asking.heard or 0, found.count),
        Finding("largest error of a pose, mm", 1e3 * max(each.note for each in samples)),
        Finding("longest time until a replacement served, s", max(away_s, default=0.0)),
    ]


if __name__ == "__main__":
    parser = command_line(__doc__)
    parser.add_argument("--minutes", type=float, default=MINUTES, help="how long (default: %(default)s)")
    run_experiment(parser, measure)
