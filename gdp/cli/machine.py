"""Start of a machine's programs, for the commands that create or join a domain."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli.node import set_up_logging
from gdp.enrolment.addresses import default_directory
from gdp.enrolment.programs import MachineProgram, missing_ros, read_machine
from gdp.enrolment.service_units import service_texts
from gdp.enrolment.supervisor import Failures, supervise
from gdp.enrolment.units import has_systemd, install_units
from gdp.errors import GdpError
from gdp.host.interruption import Interrupted, interruptible
from gdp.intervals import TICK_S
from gdp.management.control_client import ask_node, find_control_socket
from gdp.state.control_protocol import Command
from gdp.terminal import echo, unblocked

BORDER_SEEN_S: Final = 20.0

AtDirectory = Annotated[
    Path | None, typer.Option("--directory", metavar="DIR", help="where the files are; /var/lib/gdp/NAME for root")
]
NoSystemd = Annotated[bool, typer.Option("--no-systemd", help="run in the foreground until Ctrl-C, without units")]
Start = Annotated[bool, typer.Option("--start/--no-start", help="start the programs of this machine")]


def directory_of(name: str, stated: Path | None) -> Path:
    """Return the directory of a domain's files: the stated one, or the default for this user."""
    state_home = os.environ.get("XDG_STATE_HOME", "")
    return stated or default_directory(name, is_root=os.geteuid() == 0, state_home=state_home)


def say(text: str) -> None:
    """Write a line for people; results go to standard output, which programs may read."""
    echo(text, err=True)


def start_machine(directory: Path, *, no_systemd: bool, observed: Callable[[Path], None] | None = None) -> None:
    """Start the programs of a machine: as systemd units, or in the foreground until Ctrl-C.

    Args:
        observed: called in a thread once they were started, to say what can be seen.

    Raises:
        LocalError: the directory is no member's, or a program or a unit cannot be started.
    """
    machine = read_machine(directory)
    if reason := missing_ros():
        say(f"no proxy runs here: {reason}")
    if has_systemd() and not no_systemd:
        units = service_texts(machine)
        install_units(units)
        say(f"started, now and at each boot: {' '.join(units)}")
        if observed is not None:
            observed(directory)
        return

    async def started() -> None:
        """Observe without holding up the supervisor."""
        if observed is not None:
            await asyncio.get_running_loop().run_in_executor(None, observed, directory)

    run_programs(machine.programs, started)


def run_programs(programs: Sequence[MachineProgram], started: Callable[[], Awaitable[None]] | None = None) -> None:
    """Run programs in the foreground until Ctrl-C, and exit: with 1 if one of them has failed, else with 0.

    Raises:
        LocalError: a program cannot be started at all.
    """
    sys.stderr = unblocked(sys.stderr)  # it has the output of all programs, which are to be restarted meanwhile
    set_up_logging(verbose=False)
    say(f"running {', '.join(each.name for each in programs)} in the foreground; Ctrl-C ends them")
    failures = Failures()
    try:
        asyncio.run(interruptible(supervise(programs, started, failures)))
    except Interrupted:
        if failures.names:
            say(f"error: failed: {', '.join(sorted(failures.names))}; the log has their last words")
        sys.exit(1 if failures.names else 0)


def paths_up(directory: Path, deadline_s: float = BORDER_SEEN_S) -> tuple[list[str], bool]:
    """Return the labels of the peers whose tunnels are up, and whether a relay is; once there is one, or in the end."""
    end_s = time.monotonic() + deadline_s
    while True:
        found = _labels_up(directory, "links"), bool(_labels_up(directory, "relay"))
        if any(found) or time.monotonic() >= end_s:
            return found
        time.sleep(TICK_S)


def _labels_up(directory: Path, key: str) -> list[str]:
    with contextlib.suppress(GdpError):  # the switch is still starting
        status = ask_node(find_control_socket(directory / "switch"), Command.STATUS, 2.0)
        links = status.result.get(key) if status.is_ok else None
        if isinstance(links, list):
            return [str(each.get("label")) for each in links if isinstance(each, dict) and each.get("up") is True]
    return []
