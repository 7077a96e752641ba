"""``gdp explain``: why a name does not arrive, in one sentence, with the next command to type.

I/O. Exit codes: 0 it arrives or is idle, 1 a fault was found, 2 wrong input, 3 the facts do not suffice.
"""

from __future__ import annotations

import json
import time
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.fact_gathering import FactGathering, LocalDirectory, local_directory
from gdp.cli.local_nodes import local_nodes
from gdp.diagnosis.answer import Answer, Verdict
from gdp.diagnosis.diagnosis import diagnose
from gdp.errors import LocalError
from gdp.management.running_nodes import RunningNode
from gdp.terminal import echo

_EXITS: Final = {Verdict.FINE: 0, Verdict.FAULT: 1, Verdict.UNKNOWN: 3}
_WINDOW_S: Final = 1.0

Nodes = Annotated[
    list[str],
    typer.Option(
        "--node",
        metavar="NODE_DIR",
        help="Directory or control socket of a node of this machine; the first is the proxy that asks. Further ones"
        " are asked directly. Default: all running nodes of this machine, which must have one proxy.",
    ),
]
Window = Annotated[
    float, typer.Option("--seconds", min=0.1, max=60, metavar="SECONDS", help="How long to watch the counters.")
]


def explain(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A ROS name of this machine, or 64 hex digits.")],
    node: Nodes = [],  # noqa: B006 - typer reads the default, nothing changes it
    seconds: Window = _WINDOW_S,
    as_json: options.Json = False,
) -> None:
    """Say why a topic or service does not arrive, and what to type next.

    It asks the proxy here, its switch, the RIB, the switches on the path and their proxies, as far as their members may
    know. The exit code is 0 if it arrives or is idle, 1 for a fault, and 3 if the facts do not suffice.

    \b
    Example:
      gdp explain /camera/image
      gdp explain /camera/image --node robot/proxy --json
      gdp explain /camera/image --node robot/proxy --node robot/switch --seconds 5
    """
    near, others = _nodes(node)
    gathering = FactGathering(name, near, others)
    before, begun_s = gathering.sample(with_host=False), time.monotonic()
    time.sleep(seconds)  # counters say what happens now only by their difference
    facts = gathering.sample().since(before, time.monotonic() - begun_s)
    answer = diagnose(facts)
    _print(answer, near.place, as_json=as_json)
    raise typer.Exit(_EXITS[answer.cause.verdict])


def _nodes(given: list[str]) -> tuple[LocalDirectory, list[LocalDirectory]]:
    """Return the proxy that asks and the other nodes. Raises ``LocalError``: it is not clear which proxy asks."""
    if given:
        nodes = [local_directory(each) for each in given]
        if nodes[0].role not in ("", "proxy"):
            raise LocalError(f"--node {given[0]}: the first node is the proxy that asks; this is a {nodes[0].role}")
        return nodes[0], nodes[1:]
    running = local_nodes()
    proxies = [each for each in running if each.role == "proxy"]
    if len(proxies) > 1:
        listed = ", ".join(each.title for each in proxies)
        raise LocalError(f"several proxies run here ({listed}); say which asks: --node PROXY_DIR")
    if not proxies:
        raise LocalError("no proxy of this user runs here; start one, run this as its user, or say --node PROXY_DIR")
    return _directory(proxies[0]), [_directory(each) for each in running if each.role != "proxy"]


def _directory(node: RunningNode) -> LocalDirectory:
    return LocalDirectory(node.title, node.socket, node.role)


def _print(answer: Answer, place: str, *, as_json: bool) -> None:
    command = answer.command.replace("NODE_DIR", place)
    if as_json:
        fields = {**answer.to_fields(), "command": command or None}
        echo(json.dumps(fields, ensure_ascii=False))
        return
    echo(answer.sentence)
    if command:
        echo(f"next: {command}")
    if answer.cause.verdict is not Verdict.FINE:
        for each in answer.unknown:
            echo(f"not asked: {each}")
