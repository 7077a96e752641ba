"""``gdp show``: tables of the nodes of this machine.

I/O; over their control sockets.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import Enum
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.local_nodes import connect, local_nodes
from gdp.cli.options import Host
from gdp.cli.tables import print_table, select_columns
from gdp.errors import LocalError
from gdp.management.control_client import NodeConnection, NotRunningError
from gdp.management.running_nodes import RunningNode
from gdp.terminal import echo

_NOTHING = 1


class Table(str, Enum):
    """A table that nodes keep."""

    NEIGHBORS = "neighbors"
    LINKS = "links"
    ROUTES = "routes"
    TREES = "trees"
    NAMES = "names"
    TUNNELS = "tunnels"
    DROPS = "drops"
    PEERS = "peers"
    CONTROL = "control"


What = Annotated[
    Table,
    typer.Argument(metavar="TABLE", help="neighbors, links, routes, trees, names, tunnels, drops, peers or control."),
]
OneNode = Annotated[
    str | None,
    typer.Option(
        "--node", metavar="NODE", help="This node only: its directory, its label or its control socket. Default: all."
    ),
]
Columns = Annotated[
    str | None, typer.Option("--columns", metavar="A,B,C", help="Print these columns only, in this order.")
]


def show_table(
    what: What, node: OneNode = None, host: Host = False, columns: Columns = None, as_json: options.Json = False
) -> None:
    """Show a table of every node that runs on this machine, or of one.

    neighbors: the nodes at the other ends of our links. links: our devices. routes: the forwarding table of a switch.
    trees: its multicast trees. names: what is advertised. tunnels: its tunnels. drops: dropped frames by reason.
    peers: other switches and RIBs; of a proxy, the writers and readers of its names. control: of a proxy, the topics
    under exclusive control, and their holders.

    On a terminal, names are short and lines end at its width. In a pipe and in a file everything is whole.

    \b
    Example:
      gdp show neighbors
      gdp show drops --node robot/proxy
      gdp show routes --json | jq '.rows[].destination'
      gdp show names --columns local,name
    """
    rows = _of_one(what, node) if node is not None else _of_all(what, is_host=host)
    if as_json:
        echo(json.dumps({"table": what.value, "rows": rows}))
        return
    chosen = select_columns(rows, columns)
    if rows:
        print_table(rows, chosen)
    else:
        echo(f"gdp: the table {what.value} is empty", err=True)


def _of_one(what: Table, node: str) -> list[Mapping[str, object]]:
    with connect(node) as connection:
        return connection.show(what.value)


def _of_all(what: Table, *, is_host: bool) -> list[Mapping[str, object]]:
    nodes = local_nodes(is_host=is_host)
    if not nodes:
        raise NotRunningError("no node of this user runs here, or its control_socket is elsewhere; say --node DIR")
    rows: list[Mapping[str, object]] = []
    keepers = 0
    for each in nodes:
        found = _table_of(each, what)
        if found is not None:
            keepers += 1
            rows += [{"node": each.title, **row} for row in found]
    if not keepers:
        roles = ", ".join(sorted({each.role for each in nodes}))
        raise LocalError(f"no node here keeps the table {what.value}: the nodes here are of the roles {roles}")
    return rows


def _table_of(node: RunningNode, what: Table) -> list[Mapping[str, object]] | None:
    """Return the rows of one node; None: it keeps no such table, or has ended."""
    try:
        with NodeConnection(node.socket) as connection:
            return connection.show(what.value)
    except LocalError:
        return None
