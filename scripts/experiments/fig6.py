"""Figure 6: segmentation while a second client contends for one replica. One server against two.

sudo .venv/bin/python scripts/experiments/fig6.py                  # writes docs/experiments/fig6.*
sudo .venv/bin/python scripts/experiments/fig6.py --quick          # a few seconds: does it work?
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Final

import typer
from carrier import TYPE
from field import Served, Work
from machine import machine_state
from pictures import save_distributions
from samples import Sample, Summary
from series import Rivalry, Series
from study import (
    Asking,
    Finding,
    JsonOption,
    OutOption,
    QuickOption,
    Report,
    conclude,
    field_of,
    place_of,
)

__all__: list[str] = []

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

REQUESTS: Final = 100
QUICK: Final = 5
ON_S: Final = 1.1
OFF_S: Final = 1.0
_GAP_S: Final = 0.23  # shares no beat with the second client
_PATIENCE_S: Final = 10.0
_MACHINES: Final = ("m1", "m2")
_ONE, _TWO = "/segment/m1", "/segment"
_CASES: Final = ("one server", "two replicas")
_SERVERS: Final = {"segment": "servers compute", "light": "servers wait"}
_TAKES_S: Final = 0.06
_QUICK_ROLE: Final = "light"
_SETTING: Final = (
    "A robot calls a service that segments frames of 640 x 480 bytes. A second client of the same service, beside"
    f" the replica m1, alternates: for {ON_S:g} s it asks m1 again and again, then it rests for {OFF_S:g} s. The node"
    " serves one request after the other. *One server* is m1; *two replicas* are m1 and m2, where nobody else asks."
    " Both cases take turns, request by request, with the same frames.",
    "*Servers compute*: the whole segmentation runs on the machine's own cores. *Servers wait*: they segment every"
    " fourth row and column and wait until 60 ms have passed, as where a processor of their own works; what is left is"
    " the queue in front of the contended replica, and the overlay.",
)
_NOTES: Final = (
    "The segmentation is a stand-in: smoothing at seven scales, thresholds and connected components, about 60 ms of"
    " one core; how many regions it finds is checked against the scene that was drawn. The paper ran a neural"
    " network.",
    "The service type is rcl_interfaces/srv/SetParameters, whose integer array carries the frame (307,200 bytes): the"
    " installed packages have no service that takes an image.",
    "While the second client is busy and the servers compute, three processes want a core at once: with two cores the"
    " robot's request to the second replica pays for a part of it, which two machines would not.",
)


@app.command(epilog="Example: sudo .venv/bin/python scripts/experiments/fig6.py --requests 20 --out /tmp/fig6")
def main(
    requests: Annotated[int, typer.Option(min=2, help="Of each case.")] = REQUESTS,
    quick: QuickOption = False,
    as_json: JsonOption = False,
    out: OutOption = None,
) -> None:
    """Segment frames while a second client contends for one replica."""
    state, place = machine_state(), place_of(out, quick=quick)
    count = QUICK if quick else requests
    served = [Served(_TWO, TYPE, _MACHINES), Served(_ONE, TYPE, _MACHINES[:1])]
    names = {each: " ".join(s.name for s in served if each in s.machines) for each in _MACHINES}
    series = Series("segment", (_ONE, _TWO), 2 * count, _MACHINES, _PATIENCE_S, gap_s=_GAP_S)
    rivalry = Rivalry("segment", _ONE, ON_S, OFF_S)
    groups: dict[str, list[Sample]] = {}
    findings = []
    kinds = {_QUICK_ROLE: _SERVERS[_QUICK_ROLE]} if quick else _SERVERS
    for role, what in kinds.items():
        work = {each: Work(role, {"services": names[each], "takes_s": _TAKES_S}) for each in _MACHINES}
        with (
            field_of(served, work) as here,
            here.client(_MACHINES[0], "busy", **asdict(rivalry)),
            Asking(here, series) as asking,
        ):
            found, plane = asking.by_service(what), here.data_plane
        groups[f"{what}, one server"], groups[f"{what}, two replicas"] = found[_ONE], found[_TWO]
        one, two = Summary.of(found[_ONE]), Summary.of(found[_TWO])
        findings += [
            Finding(f"mean gain, {what}", one.mean_s / two.mean_s),
            Finding(f"p99 gain, {what}", one.p99_s / two.p99_s, paper="2.1, in its abstract"),
        ]
    report = Report(
        "fig6",
        "Figure 6: segmentation, one replica contended",
        "sudo .venv/bin/python scripts/experiments/fig6.py",
        _SETTING,
        groups,
        findings,
        _NOTES,
        {"requests of each case": count, "switches": plane},
    )
    if place is not None:
        panels = {
            what: {case: [1e3 * each.latency_s for each in groups[f"{what}, {case}"]] for case in _CASES}
            for what in kinds.values()
        }
        save_distributions(place / "fig6.png", report.title, panels, "latency, ms")
    conclude(report, state, place, ["fig6.png"], as_json=as_json)


if __name__ == "__main__":
    app()
