"""Options and output of the commands that read or call one name as a member."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import orjson
import typer

from gdp.cli.completion import complete_node
from gdp.cli.node import AwaitIface, Json, Verbose, failing_clearly, set_up_logging
from gdp.errors import GdpError
from gdp.terminal import echo, for_stdout

if TYPE_CHECKING:
    from proxy.node.tool_member import Access, Wanted

Iface = Annotated[
    str | None, typer.Option("--iface", metavar="DEVICE", help="Device towards the switch. Default: as the node says.")
]
Delegations = Annotated[
    Path | None,
    typer.Option("--delegations", metavar="DIR", help="What owners gave the node. Default: as the node says."),
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
    return _held(context, incomplete, "read")


def complete_callable(context: typer.Context, incomplete: str) -> list[str]:
    """Return the services that the line's node may call."""
    return _held(context, incomplete, "call")


def _held(context: typer.Context, incomplete: str, right: str) -> list[str]:
    """Return names from delegations; none where the line has no readable node, since a completion prints no error."""
    node = context.params.get("node") or os.environ.get("GDP_NODE")
    if not node:
        return []
    from gdp.trust.right import Right
    from proxy.node.tool_member import names_held

    try:
        return sorted({name for name in names_held(Path(node), Right(right)) if name.startswith(incomplete)})
    except GdpError:
        return []


class ToolOptions(NamedTuple):
    """Options of every tool: which member it is, and what it prints."""

    iface: Iface = None
    delegations: Delegations = None
    await_iface: AwaitIface = 0.0
    json: Json = False
    verbose: Verbose = False

    def find_access(self, node: Path, wanted: Wanted) -> Access:
        """Return the access of a node to a name, once its device is there.

        Raises:
            LocalError: there is no such node or device, or the node lacks the right.
        """
        from gdp.links.uplink import wait_for_device
        from proxy.node.tool_member import find_access

        access = find_access(node, self.iface, self.delegations, wanted)
        wait_for_device(access.config.iface, self.await_iface)
        return access


@contextlib.contextmanager
def running_tool(options: ToolOptions) -> Iterator[None]:
    """End with exit code 1 where nothing came in time, with 0 where the reader of a pipe has what it wants, else 2."""
    set_up_logging(verbose=options.verbose, quiet=True)
    with failing_clearly():
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
