"""``gdp reload``, ``gdp status`` and ``gdp drain``: commands to a running node.

I/O. Exit codes: 0 done, 1 the node refused or ended before it was done, 2 wrong input, 3 no node runs there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.completion import complete_node
from gdp.cli.output import show
from gdp.errors import LocalError
from gdp.intervals import DRAIN_S
from gdp.management.control_client import NotRunningError, find_control_socket, request_control
from gdp.state.control_protocol import Command, Response
from gdp.terminal import echo

_FAILED: Final = 1
_NOT_RUNNING: Final = 3

NodeDirectory = Annotated[
    Path | None,
    typer.Argument(
        metavar="NODE_DIR", autocompletion=complete_node, help="Directory of the node's keys, or of the state of fog."
    ),
]
Socket = Annotated[
    Path | None,
    typer.Option("--socket", metavar="FILE", help="The node's control_socket, where its configuration names one."),
]
Timeout = Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="How long to wait for each response.")]


def reload(
    node: NodeDirectory = None, socket: Socket = None, timeout: Timeout = 10.0, as_json: options.Json = False
) -> None:
    """Make a running node read its configuration, certificates and delegations again.

    The exit code is 1 if the node keeps the old configuration; the text gives the reason.

    \b
    Example:
      gdp reload robot/proxy
      gdp reload --socket /run/gdp/proxy.sock --json
    """
    _run(Command.RELOAD, node, socket, timeout, as_json=as_json)


def status(
    node: NodeDirectory = None,
    socket: Socket = None,
    timeout: Timeout = 10.0,
    all_: Annotated[bool, typer.Option("--all", help="Counters that are zero, too.")] = False,
    as_json: options.Json = False,
) -> None:
    """Show the identity, the uptime and the counters of a running node.

    \b
    Example:
      gdp status robot/switch
      gdp status robot/proxy --json
    """
    _run(Command.STATUS, node, socket, timeout, as_json=as_json, has_zeros=all_)


def drain(
    node: NodeDirectory = None, socket: Socket = None, timeout: Timeout = DRAIN_S, as_json: options.Json = False
) -> None:
    """Make a running node finish its work and end; return when the node has finished.

    The exit code is 1 if work was left unfinished.

    \b
    Example:
      gdp drain robot/proxy
      gdp drain robot/rib --timeout 5
    """
    _run(Command.DRAIN, node, socket, timeout, as_json=as_json)


def _run(
    command: Command, node: Path | None, socket: Path | None, timeout_s: float, *, as_json: bool, has_zeros: bool = True
) -> None:
    if (node is None) == (socket is None):
        raise LocalError(f"{command.value}: name either NODE_DIR or --socket FILE")
    path = socket if socket is not None else find_control_socket(node or Path())
    last = Response()
    try:
        for last in request_control(path, command, timeout_s):
            if command is not Command.DRAIN or not last.is_ok or last.result.get("state") == "drained":
                break
        else:
            last = Response(error="the node ended before it answered")
    except NotRunningError as error:
        _fail(str(error), _NOT_RUNNING, as_json=as_json)
    if not last.is_ok:
        _fail(f"{path}: {last.error}", _FAILED, as_json=as_json)
    show(last.result if as_json else _flat(last.result, has_zeros=has_zeros), as_json=as_json)
    if last.result.get("complete") is False:
        echo(f"error: {path}: the node ended with unfinished work", err=True)
        raise typer.Exit(_FAILED)


def _flat(fields: Mapping[str, object], *, has_zeros: bool) -> dict[str, object]:
    """Return nested mappings as one, with keys such as ``drops.no-reader``; zeros in them are left out."""
    rows: dict[str, object] = {}
    for key, value in fields.items():
        if isinstance(value, Mapping):
            nested = _flat(value, has_zeros=has_zeros)
            rows |= {f"{key}.{each}": its for each, its in nested.items() if has_zeros or its not in (0, None, "", [])}
        else:
            rows[key] = value
    return rows


def _fail(reason: str, code: int, *, as_json: bool) -> None:
    if as_json:
        echo(json.dumps({"error": reason}))
    echo(f"error: {reason}", err=True)
    raise typer.Exit(code)
