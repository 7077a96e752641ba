"""``gdp unit``: systemd units of this machine's nodes.

I/O. Exit codes: 0 done, 1 a unit is not up, 2 wrong input, 3 no unit is installed.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.machine import say
from gdp.cli.output import show
from gdp.cli.tables import columns
from gdp.enrolment.programs import check_program, read_machine
from gdp.enrolment.service_status import UnitState, known_units, unit_state
from gdp.enrolment.service_units import service_texts
from gdp.enrolment.units import UNIT_FOLDER, has_systemd, install_units, installed_units, remove_units
from gdp.errors import LocalError
from gdp.intervals import SERVER_S

_NOT_WELL: Final = 1
_NOTHING: Final = 3
_ETC: Final = Path("/etc/gdp")


app = typer.Typer(help="systemd units of this machine's nodes.", no_args_is_help=True)

Where = Annotated[
    Path | None, typer.Argument(metavar="[PATH]", help="The machine's folder or its machine.yaml; by default /etc/gdp.")
]
Whose = Annotated[
    Path | None, typer.Argument(metavar="[DIR]", help="The machine's folder; by default all that gdp unit installed.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the files, and change nothing.")]


@app.command()
def install(path: Where = None, dry_run: DryRun = False, as_json: options.Json = False) -> None:
    """Write a unit for each node of a machine, start it now and at each boot, and wait until all are up.

    The nodes are those of machine.yaml, or of switch, relay, rib, proxy, store and fog.yaml in the folder.
    Each configuration is checked first. If a unit does not start, all are removed again.

    \b
    Examples:
      gdp unit install /srv/robot
      gdp unit install /srv/robot --dry-run
      gdp unit install
    """
    machine = read_machine(_ETC if path is None else path, with_fog=True)
    if machine.missing_proxy is not None:
        raise LocalError(f"{machine.missing_proxy}: no such file; gdp up {machine.directory} --suggest writes one")
    units = service_texts(machine)
    files = {str(UNIT_FOLDER / name): text for name, text in units.items()}
    if dry_run:
        show({"files": files}, as_json=as_json, plain="\n".join(f"# {name}\n{text}" for name, text in files.items()))
        return
    _require_rights(f"install {machine.directory}")
    _refuse_foreign(units)
    for each in machine.programs:
        check_program(each)
    older = [each for each in installed_units(machine.directory) if each not in units]
    if older:
        remove_units(older)  # of nodes that this machine no longer has
    try:
        install_units(units)
    except LocalError as error:
        shown = [_last_words(each) for each in units]
        remove_units(list(units))
        text = "\n".join([f"unit install: {error}; all units are removed again", *filter(None, shown)])
        raise LocalError(text) from error
    states = [unit_state(each) for each in units]
    result = {"directory": str(machine.directory), "units": [asdict(each) for each in states], "removed": older}
    show(result, as_json=as_json, plain=_table(states))
    say("started, now and at each boot; gdp unit status shows them, gdp unit remove takes them away")


@app.command()
def remove(directory: Whose = None, as_json: options.Json = False) -> None:
    """Stop the units that were installed, and delete their files; keys and configuration stay.

    \b
    Examples:
      gdp unit remove /srv/robot
      gdp unit remove
    """
    where = None if directory is None else _folder(directory)
    units = installed_units(where)
    if not units:
        raise _nothing_there(where)
    _require_rights("remove")
    remove_units(list(reversed(units)))
    show({"removed": units}, as_json=as_json, plain="\n".join(f"removed {each}" for each in units))


@app.command()
def status(directory: Whose = None, as_json: options.Json = False) -> None:
    """Show each unit, whether it starts at boot, and whether its node is ready.

    \b
    Examples:
      gdp unit status
      gdp unit status /srv/robot --json
    """
    where = None if directory is None else _folder(directory)
    _require_systemd("status")
    units = known_units(where)
    if not units:
        raise _nothing_there(where)
    states = [unit_state(each) for each in units]
    show({"units": [{**asdict(each), "well": each.is_well} for each in states]}, as_json=as_json, plain=_table(states))
    if not all(each.is_well for each in states):
        first = next(each for each in states if not each.is_well)
        say(f"error: {first.unit} is not well; its log: journalctl --unit={first.unit}")
        raise typer.Exit(_NOT_WELL)


def _folder(path: Path) -> Path:
    return (path.parent if path.is_file() else path).absolute()


def _nothing_there(directory: Path | None) -> typer.Exit:
    of = "" if directory is None else f" for {directory}"
    say(f"error: no unit is installed{of}; gdp unit install {directory or 'PATH'} makes them")
    return typer.Exit(_NOTHING)


def _require_systemd(what: str) -> None:
    if not has_systemd():
        raise LocalError(
            f"unit {what}: systemd does not run this host (there is no /run/systemd/system); gdp up runs the same"
            " nodes in the foreground, for a container or another service manager"
        )


def _require_rights(what: str) -> None:
    _require_systemd(what.partition(" ")[0])
    if os.geteuid() != 0:
        raise LocalError(f"unit: units of the system need root; run: sudo gdp unit {what}")


def _refuse_foreign(units: Mapping[str, str]) -> None:
    """Raise ``LocalError`` before a unit of another machine, or one that a person wrote, would be replaced."""
    for name, text in units.items():
        path = UNIT_FOLDER / name
        if path.exists() and path.read_text(encoding="utf-8").partition("\n")[0] != text.partition("\n")[0]:
            raise LocalError(
                f"{path} is there and belongs to something else; remove it, or rename the machine's folder"
            )


def _last_words(unit: str) -> str:
    """Return the end of a unit's journal; empty where there is none."""
    argv = ["journalctl", "--no-pager", "--lines=5", "--output=cat", f"--unit={unit}"]
    try:
        done = subprocess.run(argv, capture_output=True, text=True, timeout=SERVER_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{unit}: its journal cannot be read: {error}"
    return "\n".join(f"{unit}: {line}" for line in done.stdout.splitlines() if line)


def _table(states: Sequence[UnitState]) -> str:
    rows = []
    for each in states:
        up = "" if each.uptime_s is None else f", up {each.uptime_s:g} s"
        node = "-" if each.node is None else f"{each.node}{up}"
        rows.append((each.unit, each.active, "yes" if each.enabled else "no", str(each.restarts), node))
    return "\n".join(columns(("unit", "state", "at boot", "restarts", "node"), rows))
