"""Command ``python -m internet_demo``, which ``scripts/internet_demo.sh`` runs after its setup.

I/O. Exit status: 0 nothing lost, 1 something lost, 2 wrong input, 130 and 143 for Ctrl-C and SIGTERM.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Annotated, Final

import typer
from rich.console import Console

from gdp.errors import LocalError
from gdp.host.interruption import let_nothing_interrupt
from gdp.host.run_registry import RunRegistry
from internet_demo.figure1 import run_figure1
from internet_demo.scenario import Display, Outcome, Pace, run_scenario
from lab.command import console_of, end_on_signals, exit_with, new_app, tell
from lab.internet.laboratory import TOOLS, Laboratory
from lab.process import new_run

_PACE: Final = Pace()

_EXAMPLES: Final = """\b
Examples:
  sudo scripts/internet_demo.sh
  sudo scripts/internet_demo.sh --rate 50 --delay 20
  sudo scripts/internet_demo.sh --figure1
  sudo scripts/internet_demo.sh --json > outcome.json
"""

app = new_app()


@app.command(epilog=_EXAMPLES)
def demo(
    rate: Annotated[float, typer.Option(min=1, max=200, help="Images, and calls, a second.")] = _PACE.rate_hz,
    calm: Annotated[float, typer.Option(min=0.5, help="Seconds after each event.")] = _PACE.calm_s,
    delay: Annotated[float, typer.Option(min=0, max=500, help="Delay of each uplink, in ms.")] = _PACE.delay_ms,
    figure1: Annotated[bool, typer.Option("--figure1", help="Figure 1 of FogROS G: ROS 2 drone, ROS 1 cloud.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON; all else on stderr.")] = False,
) -> None:
    """A robot behind NATs, two clouds and an edge box on IPv6 form a domain by tokens, and their networks change.

    The robot's address changes twice, NATs forget their mappings, and one of the robot's two uplinks is cut, while
    images and calls cross. It takes about a minute; the last line says how many of them were lost. Everything is gone
    afterwards, also after Ctrl-C; what a killed demonstration left, the next one removes.
    """
    play, pace = run_figure1 if figure1 else run_scenario, Pace(rate_hz=rate, calm_s=calm, delay_ms=delay)
    exit_with(partial(_run, play, pace, console_of(stderr=as_json), as_json))


def main() -> None:
    """Run the command; never returns."""
    app(prog_name="internet_demo.sh")


def _run(play: Callable[[Laboratory, Pace, Display], Outcome], pace: Pace, console: Console, as_json: bool) -> int:
    if missing := [tool for tool in TOOLS if shutil.which(tool) is None]:
        raise LocalError(f"not installed: {', '.join(missing)} (packages iproute2, nftables, conntrack)")
    for swept in RunRegistry().sweep():
        console.print(f"removed what run {swept} had left behind")
    end_on_signals()
    with new_run() as run:
        with Laboratory(run) as laboratory, Display(console) as display:
            outcome = play(laboratory, pace, display)
        let_nothing_interrupt()
    what = "images and commands" if outcome.drawing else f"images to two readers, {outcome.calls} calls"
    pauses = (f"longest pause {each.pause_s * 1e3:5.0f} ms: {each.text}" for each in outcome.events)
    return tell(
        console,
        (*outcome.reasons, *outcome.drawing, *pauses),
        f"{outcome.images} {what}, {outcome.doubled} doubled, {outcome.lost} lost",
        asdict(outcome),
        failed=bool(outcome.lost or outcome.doubled or not outcome.images),
        as_json=as_json,
    )
