"""``gdp trace``: the switches between a node of this machine and where a name is advertised, and the trees below.

I/O; over the control socket of a node of this machine, which sends the requests as the member that it is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.local_nodes import Node, connect, find_name
from gdp.cli.path_probe import PathProbe
from gdp.cli.path_view import path_lines
from gdp.cli.ping import NameText
from gdp.cli.places import NOWHERE, find_places
from gdp.errors import LocalError
from gdp.terminal import echo

_NOTHING_CAME: Final = 1

Budget = Annotated[
    float,
    typer.Option(
        "-W", "--timeout", min=0.05, max=60, metavar="SECONDS", help="Time for each member that advertises the name."
    ),
]


def trace(name: NameText, timeout: Budget = 0.45, node: Node = None, as_json: options.Json = False) -> None:
    """Show each switch between here and the members that publish or serve a name, and the tree branches below them.

    A switch of our own domain tells its links and branches. One of another domain tells domain and delay only, unless
    its configuration names our domain (domain.diagnostics). Of several servers the nearest comes first: rules with
    replication nearest ask the first one that answers.
    The exit code is 1 if a member that advertises the name did not answer.

    \b
    Example:
      gdp trace /camera/image
      gdp trace /camera/image --node robot/switch
      gdp trace 75e0...0fc --json
    """
    begun_s = time.monotonic()
    with connect(node) as connection:
        asked = find_name(name, connection)
        places = find_places(connection, asked)
        if not places:
            raise LocalError(f"{name}: {NOWHERE}")
        probe = PathProbe(connection, asked)
        found: list[Mapping[str, object]] = []
        for place in places:
            path = {"right": place.right, "cost": place.cost, **probe.path_to(place.node, time.monotonic() + timeout)}
            has_nearest = any(each["is_nearest"] for each in found)
            is_nearest = place.cost is not None and bool(path["answered"]) and not has_nearest
            found.append({**path, "is_nearest": is_nearest})
            if not as_json:
                for line in path_lines(name, found[-1]):
                    echo(line)
    elapsed_ms = round(1e3 * (time.monotonic() - begun_s), 1)
    if as_json:
        echo(json.dumps({"name": asked.to_text(), "elapsed_ms": elapsed_ms, "paths": found}))
    else:
        echo(f"traced in {elapsed_ms:.0f} ms")
    if not all(path["answered"] for path in found):
        raise typer.Exit(_NOTHING_CAME)
