"""Figure 9: pose of a tag, ten times a second, while the replicas are killed one after the other and come back.

sudo .venv/bin/python scripts/experiments/fig9.py                  # writes docs/experiments/fig9.*
sudo .venv/bin/python scripts/experiments/fig9.py --quick          # a few seconds: does it work?
sudo .venv/bin/python scripts/experiments/fig9.py --minutes 10 --machines 3
"""

from __future__ import annotations

import time
from enum import Enum, auto
from typing import Final

from experiment import Asking, Finding, Options, Report, command_line, field_of, run_experiment, work_of
from field import Field, Served
from image_request import TYPE
from pictures import Span, save_timeline
from report import progress
from samples import Sample, Summary
from series import Series

MINUTES: Final = 2.0
QUICK_MINUTES: Final = 0.06
_SERVICE: Final = "/tag"
_HZ: Final = 10.0
_DOWN_S: Final = 2.0  # pause before a killed machine starts again
_STEADY_S: Final = 4.0  # time from its first answer until the next machine is killed
_QUICK_STEADY_S: Final = 1.0
_LANES: Final = 1_000  # the camera does not wait for answers
_PATIENCE_S: Final = 10.0
_SETTING: Final = (
    "A robot's camera sees an AprilTag. Ten times a second a frame of 640 x 480 bytes goes to a service that finds"
    " the tag's pose, whether or not earlier answers are there. The service has replicas. One is killed (SIGKILL to"
    f" its node and its proxy at once), started again {_DOWN_S:g} s later. When it answers again, the next one is"
    " killed. There is always one that serves, and never for long the same one.",
    "A request fails when its answer does not come within 10 s, or when the pose is more than 5 mm or 0.03 rad off. How"
    " many answers reach each call is counted by ROS 2's service introspection in the robot's node.",
)
_NOTES: Final = (
    "Frames are drawn for a known pose (nine rays a pixel, no lens distortion) and are not photographs. The detector"
    " is pupil-apriltags, family 36h11. The service type is rcl_interfaces/srv/SetParameters, whose integer array"
    " carries the frame: the installed packages have no service that takes an image.",
    "The paper's robot and spot machines were apart. Here all share the cores of one machine. So a machine that starts"
    " (Python, rclpy, keys) takes time from those that serve. That is most of what the timeline shows.",
)


class _Phase(Enum):
    """Phase of the machine whose turn it is."""

    SERVING = auto()
    DEAD = auto()
    COMING = auto()


class _FaultInjector:
    """Kills one machine after the other, driven by the answers as they arrive."""

    def __init__(self, place: Field, steady_s: float) -> None:
        self._servers = list(place.servers.values())
        self._steady_s = steady_s
        self._turn = 0
        self._phase = _Phase.SERVING
        self._since_s: float | None = None
        self.kills = 0
        self.spans: list[tuple[str, float, float]] = []

    def see(self, sample: Sample) -> None:
        """Handle an answer, and kill or start a machine if it is time."""
        server, now_s = self._servers[self._turn], time.monotonic()
        since_s = self._since_s = now_s if self._since_s is None else self._since_s
        passed_s = now_s - since_s
        if self._phase is _Phase.SERVING and passed_s >= self._steady_s:
            server.kill()
            self.kills += 1
            self._next(_Phase.DEAD, now_s)
            self.spans.append((server.label, now_s, now_s))
        elif self._phase is _Phase.DEAD and passed_s >= _DOWN_S:
            server.begin()
            self._phase = _Phase.COMING
        elif self._phase is _Phase.COMING and sample.machine == server.label and sample.begun_s > since_s:
            label, from_s, _ = self.spans.pop()
            self.spans.append((label, from_s, now_s))
            progress(f"{label} was away for {now_s - from_s:.1f} s")
            self._turn = (self._turn + 1) % len(self._servers)
            self._next(_Phase.SERVING, now_s)

    def _next(self, phase: _Phase, now_s: float) -> None:
        self._phase, self._since_s = phase, now_s


def measure(options: Options) -> Report:
    """Find a tag while replicas are killed and come back."""
    count = round((QUICK_MINUTES if options.quick else options.minutes) * 60 * _HZ)
    labels = tuple(f"m{number + 1}" for number in range(options.machines))
    imports = {"timeout_s": _PATIENCE_S}
    series = Series(
        "tag", (_SERVICE,), count, labels, _PATIENCE_S, lanes=_LANES, gap_s=1 / _HZ, warm_up=10, counts_answers=True
    )
    served = [Served(_SERVICE, TYPE, labels, imports=imports)]
    work = work_of(served, "tag", {each: {} for each in labels})
    with field_of(served, work) as here, Asking(here, series) as asking:
        fault_injector = _FaultInjector(here, _QUICK_STEADY_S if options.quick else _STEADY_S)
        samples = []
        for sample in asking:
            samples.append(sample)
            fault_injector.see(sample)
        plane = here.data_plane
    from_s, end_s = samples[0].begun_s, max(each.begun_s for each in samples)
    spans = [Span(label, a - from_s, (b if b > a else end_s) - from_s) for label, a, b in fault_injector.spans]
    return Report(
        "fig9",
        "Figure 9: a tag's pose while replicas are killed and come back",
        _SETTING,
        _groups(samples, spans, from_s),
        _findings(samples, asking, fault_injector),
        _NOTES,
        {"replicas": options.machines, "requests a second": _HZ, "kills": fault_injector.kills, "switches": plane},
        lambda path, title: save_timeline(path, title, samples, spans, from_s),
    )


def _groups(samples: list[Sample], spans: list[Span], from_s: float) -> dict[str, list[Sample]]:
    def is_hit(sample: Sample) -> bool:
        return any(span.from_s <= sample.begun_s - from_s < span.to_s for span in spans)

    groups = {
        "all": samples,
        "all replicas serve": [each for each in samples if not is_hit(each)],
        "one is away": [each for each in samples if is_hit(each)],
    }
    return {name: each for name, each in groups.items() if each}


def _findings(samples: list[Sample], asking: Asking, fault_injector: _FaultInjector) -> list[Finding]:
    longest_s = max((to_s - from_s for _, from_s, to_s in fault_injector.spans), default=0.0)
    found = Summary.of(samples)
    return [
        Finding("requests", found.count),
        Finding("kills", fault_injector.kills),
        Finding("failed requests", found.failed, 0, at_most=True, paper="0"),
        Finding("answers too many", asking.twice or 0, 0, at_most=True),
        Finding("answers that reached a call", asking.heard or 0, found.count),
        Finding("largest error of a pose, mm", 1e3 * max(each.note for each in samples)),
        Finding("longest time that a machine was away, s", longest_s),
    ]


if __name__ == "__main__":
    parser = command_line(__doc__)
    parser.add_argument("--minutes", type=float, default=MINUTES, help="how long (default: %(default)s)")
    parser.add_argument("--machines", type=int, choices=range(2, 9), default=2, help="replicas (default: %(default)s)")
    run_experiment(parser, measure)
