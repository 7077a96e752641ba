"""``fog-machine`` command, which runs the machine agent."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from fog.host.agent import MachineAgent
from fog.host.bundle import JOIN_FILE
from gdp.cli.node import Logs, report, running
from gdp.cli.program import Program

log = logging.getLogger(__name__)

app = Program("fog-machine")
main = app.run

Home = Annotated[
    Path, typer.Option("--home", help="The machine's folder, with boot.json.", exists=True, file_okay=False)
]
Json = Annotated[bool, typer.Option("--json", help="Say at the end why, as a line of JSON.")]
AwaitGo = Annotated[bool, typer.Option("--await-go", hidden=True)]


@app.command(epilog="Example: fog-machine --home /var/lib/fog/machine")
def machine(
    home: Home,
    json: Json = False,
    *,
    logs: Logs,
    await_go: AwaitGo = False,
) -> None:
    """Be a machine of a cluster: join if there is a token, run the programs of boot.json until SIGTERM. SIGUSR1
    drains it first.

    Its folder's status.json tells how they are, logs/ what they say.
    """
    with running(logs):
        host = MachineAgent(home.resolve())
        if await_go and not sys.stdin.readline():
            log.warning("no start command came, so no record of this machine exists")
            raise typer.Exit(1)
        reason = ""
        if (home / JOIN_FILE).exists():
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1, signal.SIGUSR2})  # until the agent handles them
            reason = _become_member(home.resolve())
        reason = reason or asyncio.run(host.run())
        report("done", f"machine ends: {reason}", json=json, reason=reason)


def _become_member(home: Path) -> str:
    """Join with the token; return why the machine never can; empty: it has.

    A machine whose token is used, unknown or expired ends, so that another one replaces it. Later starts do not need
    these imports.
    """
    from fog.host.joining import join
    from gdp.trust.enrolment_wire import EnrolmentError, Refusal

    try:
        join(home)
    except EnrolmentError as error:
        if error.code not in (Refusal.USED, Refusal.UNKNOWN_TOKEN, Refusal.EXPIRED):
            raise
        return f"the domain refuses it: {error}"
    return ""


if __name__ == "__main__":
    main()
