"""``fog logs``: what programs of machines wrote, and what they write while it runs."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Annotated, Final

import typer

from fog.bootstrap.bundles import PROXY, SWITCH
from fog.cli.options import AsJson, ClusterOption, SiteFile, State, machine_of, opened
from fog.cli.views import print_json
from fog.supervisor.background import LOG
from fog.supervisor.core.record import Record, stage
from fog.supervisor.final_logs import MACHINE
from fog.supervisor.infrastructure import open_provider
from fog.supervisor.journal import Journal
from gdp.errors import LocalError
from gdp.intervals import WATCH_S
from gdp.terminal import echo

_LINES: Final = 50
_WINDOW: Final = 2_000  # lines in which a poll looks for those that it knows
_SUPERVISOR: Final = "supervisor"
_PROGRAMS: Final = ("node", PROXY, SWITCH)

Machine = Annotated[str, typer.Argument(metavar="MACHINE", help="such as m3; see fog status")]
Program = Annotated[str, typer.Argument(metavar="[PROGRAM]", help="node, proxy or switch; empty: the machine itself")]
Lines = Annotated[int, typer.Option("--lines", "-n", min=1, help="only the last so many")]
Follow = Annotated[bool, typer.Option("--follow", "-f", help="go on as lines are written, until Ctrl-C")]


def logs(
    machine: Machine,
    program: Program = PROXY,
    cluster: ClusterOption = None,
    lines: Lines = _LINES,
    follow: Follow = False,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """Show the last lines that a program of a machine wrote; MACHINE may be supervisor.

    Of a machine that was lost the last lines of each program are kept, and shown with a word on how it ended. With
    --follow the command ends when the machine is gone. With --json each line is one object.

    \b
    Examples:
      fog logs m1 node
      fog logs m1 proxy --follow
      fog logs supervisor
    """
    with opened(site, state) as (here, journal):

        def say(texts: Sequence[str]) -> None:
            for text in texts:
                if as_json:
                    print_json({"machine": machine, "program": program, "line": text})
                else:
                    echo(text)
            sys.stdout.flush()

        if machine == _SUPERVISOR:
            program, path = "", here.state / LOG

            def lines_of_file() -> list[str] | None:
                return path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []

            _show(lines_of_file, lines, say, WATCH_S if follow else None)
            return
        record = machine_of(journal, cluster, machine)
        if record.is_gone:
            end, kept = _final_log(journal, record, program or MACHINE)
            echo(end, err=as_json)
            say(kept[-lines:])
            return
        with closing(open_provider(here)) as provider:

            def lines_of_machine() -> list[str] | None:
                if follow and machine_of(journal, cluster, machine).is_gone:
                    return None
                return provider.log(record.id, program, _WINDOW if follow else lines).splitlines()

            is_empty = _show(lines_of_machine, lines, say, max(WATCH_S, provider.poll_s) if follow else None)
            if is_empty and program not in ("", *_PROGRAMS):
                raise LocalError(f"{machine}: no line of {program!r}; programs are {', '.join(_PROGRAMS)}")
        if follow:
            echo(f"{machine} is gone; its last lines: fog logs {machine} {program}", err=True)


def new_lines(known: Sequence[str], now: Sequence[str]) -> Sequence[str]:
    """Return the lines of a window that came after those of the one before.

    Args:
        known: the earlier window; the end of it is the begin of the present one, unless all of it has left.
    """
    for start in range(max(len(known) - len(now), 0), len(known)):
        if known[start:] == now[: len(known) - start]:
            return now[len(known) - start :]
    return now


def _show(
    read: Callable[[], list[str] | None], lines: int, say: Callable[[Sequence[str]], None], every_s: float | None
) -> bool:
    """Say the last lines, and with ``every_s`` those that follow, until Ctrl-C or until ``read`` returns None.

    Return whether there were none.
    """
    known = read() or []
    say(known[-lines:])
    try:
        while every_s is not None:
            time.sleep(every_s)
            now = read()
            if now is None:
                break
            say(new_lines(known, now))
            known = now
    except KeyboardInterrupt:
        raise typer.Exit(0) from None
    return not known


def _final_log(journal: Journal, record: Record, program: str) -> tuple[str, list[str]]:
    """Return how a machine ended, and the last lines that are kept of a program."""
    kept = journal.stored_logs(record.spec.cluster, record.name)
    gone = f"{record.name} is gone: {stage(record)}, {record.reason}"
    if not kept:
        raise LocalError(f"{gone}; its logs went with it")
    if program not in kept:
        raise LocalError(f"{gone}; kept are the last lines of {', '.join(kept)}")
    return f"# {gone}; its last lines:", kept[program].splitlines()
