"""Command ``python -m fog_demo``, which ``scripts/fog_demo.sh`` runs after its setup.

I/O. Exit status: 0 no failure, 1 a failure, 2 wrong input, 130 and 143 for Ctrl-C and SIGTERM.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from fog_demo.scenario import Display, Pace, run_scenario
from lab.command import console_of, end_on_signals, exit_with, new_app, tell

_PACE: Final = Pace()

_EXAMPLES: Final = """\b
Examples:
  sudo scripts/fog_demo.sh
  sudo scripts/fog_demo.sh --rate 200 --notice 30
  sudo scripts/fog_demo.sh --json > outcome.json
"""

app = new_app()


@app.command(epilog=_EXAMPLES)
def demo(
    launch_file: Annotated[Path, typer.Argument(metavar="FILE", exists=True, hidden=True)],
    rate: Annotated[float, typer.Option(min=1, max=1_000, help="Requests a second.")] = _PACE.rate_hz,
    calm: Annotated[float, typer.Option(min=0.5, help="Seconds of plain traffic in between.")] = _PACE.calm_s,
    notice: Annotated[float, typer.Option(min=1, help="Seconds from the notice to the preemption.")] = _PACE.notice_s,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON; all else on stderr.")] = False,
) -> None:
    """A robot calls a service on two spot machines, which are taken away.

    One machine is preempted with notice, the other one killed, and each is replaced elsewhere while requests flow. It
    takes about a minute; the last line says how many of the requests failed. Everything is gone afterwards, also after
    Ctrl-C; what a killed demonstration left, the next one takes down.
    """
    exit_with(partial(_run, launch_file.absolute(), Pace(rate, calm, notice), console_of(stderr=as_json), as_json))


def main() -> None:
    """Run the command; never returns."""
    app(prog_name="fog_demo.sh")


def _run(launch_file: Path, pace: Pace, console: Console, as_json: bool) -> int:
    """Run the scenario."""
    end_on_signals()
    with Display(console) as display:
        outcome = run_scenario(launch_file, pace, display)
    document = {
        **asdict(outcome.counts),
        "by_machine": dict(outcome.counts.by_machine),
        "steps_s": outcome.steps_s,
        "events": [asdict(each) for each in outcome.events],
    }
    lines = (f"{what}: {seconds:.2f} s" for what, seconds in outcome.steps_s.items())
    has_failed = bool(outcome.counts.failed or not outcome.counts.requests)
    return tell(console, lines, outcome.summary, document, failed=has_failed, as_json=as_json)
