"""``gdp rib lookup``: who advertises a name, as the RIB states it to a switch of this machine."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.completion import complete_node
from gdp.cli.options import Host
from gdp.cli.output import moment, show
from gdp.cli.topic import KnownName, Sockets, none_runs
from gdp.errors import LocalError
from gdp.intervals import LOOK_S
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket
from gdp.management.running_nodes import RunningNode, find_running_nodes, read_topics
from gdp.names import Name
from gdp.state.control_protocol import Command
from gdp.terminal import echo

app = typer.Typer(no_args_is_help=True, help="Ask RIBs what they know.")

_NONE: Final = 1

Node = Annotated[
    Path | None,
    typer.Option(
        "--node",
        metavar="DIR",
        autocompletion=complete_node,
        help="Ask this switch or RIB alone: the directory of its keys.",
    ),
]


@app.callback()
def _rib() -> None:
    """Keep ``lookup`` a command of its own: typer would run a single one without its name."""


@app.command(no_args_is_help=True)
def lookup(
    name: KnownName,
    node: Node = None,
    type_name: Annotated[str, typer.Option("--type", metavar="TYPE", help="Its type, where several names fit.")] = "",
    timeout: Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="How long to wait for a RIB.")] = 5.0,
    socket: Sockets = [],  # noqa: B006  # typer copies it
    host: Host = False,
    as_json: options.Json = False,
) -> None:
    """Show who advertises a name: node, right, switch, domain, lease, certificate holder, and the RIB that says so.

    A switch of this machine asks its RIB; a RIB of this machine reads its store. A RIB tells a switch of its own domain
    everything, and others global names alone. Exit code 1: no node advertises the name, or no RIB answers.

    \b
    Examples:
      gdp rib lookup /camera/image
      gdp rib lookup 75e1b2... --node robot/switch --json
    """
    asked = _nodes(node, socket, is_host=host)
    wanted = _overlay_name(name, type_name, is_host=host)
    answers = {each: _answer(each, wanted, timeout) for each in asked}
    result = {"name": wanted.to_text(), "asked": [_described(each, answer) for each, answer in answers.items()]}
    if as_json:
        show(result, as_json=True)
    else:
        _print(name, wanted, answers)
    if not any(answer.get("advertisers") for answer in answers.values()):
        raise typer.Exit(_NONE)


def _nodes(node: Path | None, sockets: list[Path], *, is_host: bool) -> list[RunningNode]:
    """Return the nodes to ask: the named one, else the switches of this machine, else its RIBs."""
    only = [] if node is None else [find_control_socket(node)]
    found = find_running_nodes([*sockets, *only], is_host=is_host)
    if node is not None:
        chosen = [each for each in found.nodes if each.socket in only]
        if not chosen:
            raise NotRunningError(f"{node}: no switch or RIB runs with these keys; start it first")
        return chosen
    for role in ("switch", "leaf", "rib"):
        if chosen := [each for each in found.nodes if each.role == role]:
            return chosen
    raise none_runs()


def _overlay_name(text: str, type_name: str, *, is_host: bool) -> Name:
    """Return the 256-bit name. Raises ``LocalError``: no running node of this machine knows a ROS name, or several."""
    if len(text) == 2 * len(Name(bytes(32))):
        return Name.from_text(text)
    rows = [row for answer in read_topics(find_running_nodes(is_host=is_host)) for row in answer.rows]
    short = text.lower().replace("...", "…")
    fits = {
        row.name: row
        for row in rows
        if (text == row.topic or short == Name.from_text(row.name).short) and type_name in ("", row.type)
    }
    if not fits:
        raise LocalError(
            f"{text}: no running node of this machine knows this name; state its 64 hex digits, as 'gdp name' prints"
        )
    if len(fits) > 1:
        lines = "".join(f"\n  {row.name}  {row.topic} [{row.type}]" for row in fits.values())
        raise LocalError(f"{text}: {len(fits)} names fit; state --type, or one of them in hex:{lines}")
    return Name.from_text(next(iter(fits)))


def _answer(node: RunningNode, name: Name, timeout_s: float) -> Mapping[str, object]:
    """Ask a node until its RIB has answered, or time is up."""
    until_s = time.monotonic() + timeout_s
    while True:
        response = ask_node(node.socket, Command.LOOKUP, timeout_s, name)
        if not response.is_ok:
            return {"state": "refused", "error": response.error, "rib": None, "advertisers": []}
        if response.result.get("state") != "asked" or time.monotonic() >= until_s:
            return response.result
        time.sleep(LOOK_S)


def _described(node: RunningNode, answer: Mapping[str, object]) -> dict[str, object]:
    return {"node": node.name.to_text(), "role": node.role, **answer}


def _print(text: str, name: Name, answers: Mapping[RunningNode, Mapping[str, object]]) -> None:
    echo(f"{text}  {name.to_text()}")
    for node, answer in answers.items():
        rib, state = answer.get("rib"), answer.get("state")
        through = "no RIB" if not isinstance(rib, str) else f"RIB {Name.from_text(rib).short}"
        echo(f"{node.label}, through {through}: {state}")
        advertisers = answer.get("advertisers")
        for each in advertisers if isinstance(advertisers, list) else []:
            echo(f"  {each['right']} by {each['advertiser']}")
            echo(f"    at switch   {each['switch']}")
            echo(f"    in domain   {each['domain']}")
            echo(f"    lease       {each['left_s']:g} s left here; advertised for {each['lease_s']:g} s")
            held = f"{each['holder']!r} of domain {each['holder_domain']}"
            echo(f"    certificate {held}, valid until {moment(each['valid_until_unix_s'])}")
            echo(f"    owner's key {each['owner_key'] or 'none: an unowned name'}")
            for issuer in each["delegated_by"]:
                by = "the owner" if issuer == name.to_text() else issuer
                echo(f"    delegated   by {by}")
        if not advertisers:
            unknown = f"  no advertiser is known: {answer.get('error', state)}"
            echo("  no node advertises it" if state in ("answered", "stored") else unknown)
