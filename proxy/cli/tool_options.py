"""Options and output of the commands that read or call one name as a member.

I/O.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import orjson
import typer

from gdp.cli.completion import complete_node
from gdp.errors import GdpError
from gdp.terminal import echo, for_stdout
from gdp.trust.right import Right

__all__ = [
    "Node",
    "TypeName",
    "complete_callable",
    "complete_readable",
    "ending_quietly",
    "print_json",
    "print_text",
]

Node = Annotated[
    Path,
    typer.Option(
        "--node",
        envvar="GDP_NODE",
        metavar="NODE",
        autocompletion=complete_node,
        help="The tool's own node, which no other process may run: its directory, or its proxy.yaml.",
    ),
]
TypeName = Annotated[str, typer.Option("--type", metavar="TYPE", help="Its type, where several names fit.")]


def complete_readable(context: typer.Context, incomplete: str) -> list[str]:
    """Return the topics that the line's node may read."""
    return _held(context, incomplete, Right.READ)


def complete_callable(context: typer.Context, incomplete: str) -> list[str]:
    """Return the services that the line's node may call."""
    return _held(context, incomplete, Right.CALL)


def _held(context: typer.Context, incomplete: str, right: Right) -> list[str]:
    """Return names from delegations; none where the line has no readable node, since a completion prints no error."""
    node = context.params.get("node") or os.environ.get("GDP_NODE")
    if not node:
        return []
    from proxy.node.tool_member import names_held

    try:
        return sorted({name for name in names_held(Path(node), right) if name.startswith(incomplete)})
    except GdpError:
        return []


@contextlib.contextmanager
def ending_quietly() -> Iterator[None]:
    """End with exit code 1 where nothing came in time, and with 0 where the reader of a pipe has what it wants."""
    from proxy.node.tool_member import NoAnswerError

    try:
        yield
    except NoAnswerError as error:
        echo(f"error: {error}", err=True)
        raise typer.Exit(1) from error
    except BrokenPipeError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to flush has no reader
        raise typer.Exit(0) from error


def print_json(fields: Mapping[str, object]) -> None:
    """Print one line of JSON, and flush it."""
    print_text(orjson.dumps(dict(fields)).decode())


def print_text(text: str) -> None:
    """Print text and a line feed, and flush it."""
    sys.stdout.buffer.write(for_stdout(text).encode("utf-8", "backslashreplace") + b"\n")
    sys.stdout.buffer.flush()
