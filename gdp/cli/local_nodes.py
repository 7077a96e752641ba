"""Nodes of this machine, by their control sockets, and names by text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from gdp.errors import LocalError
from gdp.management.control_client import NodeConnection, NotRunningError, find_control_socket
from gdp.management.running_nodes import RunningNode, find_running_nodes
from gdp.names import NAME_BYTES, Name

Node = Annotated[
    str | None,
    typer.Option(
        "--node",
        metavar="NODE",
        help="The node that asks: its directory, its label or its control socket. "
        "Default: the one proxy of this machine, or else its one switch.",
    ),
]
_HEX_DIGITS = 2 * NAME_BYTES


def local_nodes(*, is_host: bool = False) -> list[RunningNode]:
    """Return the running nodes of this machine whose control socket has its usual name and is open to this user.

    What a dead process left, and what belongs to another user, cannot be asked. ``is_host``: those of all its network
    namespaces; otherwise as ``find_running_nodes`` says.
    """
    return sorted(find_running_nodes(is_host=is_host).nodes, key=lambda node: (node.role, node.title))


@contextmanager
def connect(node: str | None) -> Iterator[NodeConnection]:
    """Connect to the node that an option names, or to the one of this machine.

    Raises:
        LocalError: there is none, or there are several; the text has what to type.
    """
    with NodeConnection(_socket_of(node)) as connection:
        yield connection


def _socket_of(node: str | None) -> Path:
    if node is not None:
        path = Path(node)
        if path.is_socket():
            return path
        if path.is_dir():
            return find_control_socket(path)
        nodes = local_nodes(is_host=True)
        named = [each for each in nodes if node in (each.title, each.name.to_text())]
        if len(named) == 1:
            return named[0].socket
        word = "several running nodes have" if named else "no directory, control socket or running node has"
        raise LocalError(f"--node {node}: {word} this name; say --node DIR{_listed(nodes)}")
    nodes = local_nodes()
    for role in ("proxy", "switch", "leaf"):
        fitting = [each for each in nodes if each.role == role]
        if len(fitting) == 1:
            return fitting[0].socket
        if fitting:
            raise LocalError(f"several nodes run here; choose one with --node LABEL{_listed(fitting)}")
    raise NotRunningError(
        "no proxy and no switch of this user runs here, or its control_socket is elsewhere;"
        " start one, run this as its user, or say --node DIR"
    )


def _listed(nodes: list[RunningNode]) -> str:
    return ": " + ", ".join(f"{each.title} ({each.role})" for each in nodes) if nodes else ""


def find_name(text: str, connection: NodeConnection) -> Name:
    """Return the name that a text means: 64 hex digits, or the ROS name of one that a proxy of this machine carries.

    The node that asks goes first, then the others of this machine.

    Raises:
        LocalError: no node here carries such a name, or several names have it.
    """
    if len(text) == _HEX_DIGITS and not text.startswith("/"):
        return Name.from_text(text)
    names = _matching(text, names_of(connection)) or _matching(text, names_of_machine())
    if len(names) == 1:
        return Name.from_text(names.pop())
    if names:
        raise LocalError(f"{text}: several names are called so; give one of {', '.join(sorted(names))}")
    raise LocalError(
        f"{text}: no proxy of this machine carries it; give its 64 hex digits, which 'gdp name' prints,"
        " or look at 'gdp show names'"
    )


def names_of(connection: NodeConnection) -> list[Mapping[str, object]]:
    """Return the rows of the node's names; a node without such a table has none."""
    try:
        return connection.show("names")
    except LocalError:
        return []


def names_of_machine() -> list[Mapping[str, object]]:
    """Return the rows of the names of every proxy of this machine."""
    rows: list[Mapping[str, object]] = []
    for node in local_nodes():
        if node.role == "proxy":
            try:
                with NodeConnection(node.socket, 1.0) as connection:
                    rows += names_of(connection)
            except LocalError:
                continue  # it ended meanwhile
    return rows


def _matching(text: str, rows: list[Mapping[str, object]]) -> set[str]:
    return {str(row["name"]) for row in rows if row.get("local") == text}
