"""``gdp topic``: topics and services of this machine's running nodes; reading one as a member.

I/O. ``hz``, ``bw`` and ``echo`` are commands of the package ``proxy``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

import typer

from gdp.cli.completion import complete_node
from gdp.cli.extension import ANY_ARGUMENTS, ExtendedGroup, placeholder
from gdp.cli.options import Host, known_name
from gdp.cli.output import show
from gdp.cli.tables import bits, columns, short_count
from gdp.names import Name
from gdp.terminal import echo

if TYPE_CHECKING:  # a help text asks no node
    from gdp.management.running_nodes import Found, NodeTopics
    from gdp.management.topic_rates import RatedRow

_NOT_RUNNING: Final = 3
_UNKNOWN: Final = 1
_HEAD: Final = ("NAME", "TYPE", "DIRECTION", "MSG/S", "RATE", "SIZE", "PUBLISHERS", "READERS", "NODE")


class _Topics(ExtendedGroup):
    extensions: ClassVar[Mapping[str, str]] = dict.fromkeys(("hz", "bw", "echo"), "topic")


app = typer.Typer(cls=_Topics, no_args_is_help=True, help="List, measure and read topics.")

Sockets = Annotated[
    list[Path],
    typer.Option("--socket", metavar="FILE", help="A node's control_socket, where its configuration names one."),
]
Seconds = Annotated[float, typer.Option("--seconds", min=0.05, help="Time over which rates are measured.")]
JsonLines = Annotated[bool, typer.Option("--json", help="Print one JSON object a line.")]


Node = Annotated[
    Path | None,
    typer.Option(
        "--node",
        envvar="GDP_NODE",
        metavar="NODE",
        autocompletion=complete_node,
        help="What this node holds, too, running or not: its directory, or its proxy.yaml.",
    ),
]


def complete_known(incomplete: str) -> list[str]:
    """Return the names that the running nodes of this machine carry."""
    from gdp.management.running_nodes import find_running_nodes, read_topics
    from gdp.management.topic_rates import known_names

    rows = known_names(read_topics(find_running_nodes())).values()
    return sorted({row.topic for row in rows if row.topic.startswith(incomplete)})


KnownName = Annotated[str, known_name("/scan", complete_known)]


@app.command("list")
def list_topics(
    all_: Annotated[bool, typer.Option("--all", "-a", help="Names that are held and not used, too.")] = False,
    seconds: Seconds = 1.0,
    socket: Sockets = [],  # noqa: B006  # typer copies it
    host: Host = False,
    node: Node = None,
    as_json: JsonLines = False,
) -> None:
    """List the topics and services that this machine's running nodes carry, with rate, size, publishers and readers.

    A switch knows names in their 256-bit form alone: a proxy of this machine that knows the meaning lends it.

    \b
    Examples:
      gdp topic list
      gdp topic list --all --json
    """
    from gdp.state.topic_rows import Direction

    rows = _measured(seconds, socket, node, is_host=host)
    shown = [row for row in rows if all_ or row.row.direction is not Direction.HELD]
    if as_json:
        for row in shown:
            show(row.to_fields(), as_json=True)
        return
    for line in columns(_HEAD, [_cells(row) for row in shown]):
        echo(line)
    if held := len(rows) - len(shown):
        echo(f"{held} more held and not used; --all shows them", err=True)


@app.command(no_args_is_help=True)
def info(
    name: KnownName,
    type_name: Annotated[str, typer.Option("--type", metavar="TYPE", help="Its type, where several names fit.")] = "",
    seconds: Seconds = 1.0,
    socket: Sockets = [],  # noqa: B006  # typer copies it
    host: Host = False,
    node: Node = None,
    as_json: JsonLines = False,
) -> None:
    """Show what each running node of this machine knows of one name. Exit code 1: none of them knows it.

    \b
    Examples:
      gdp topic info /camera/image
      gdp topic info /scan --type sensor_msgs/msg/LaserScan --json
    """
    rows = [row for row in _measured(seconds, socket, node, is_host=host) if _fits(row, name, type_name)]
    if not rows:
        echo(f"error: {name}: no running node of this machine knows it; 'gdp topic list --all' shows all", err=True)
        raise typer.Exit(_UNKNOWN)
    for at, row in enumerate(rows):
        if at and not as_json:
            echo()
        show(row.to_fields() if as_json else _described(row), as_json=as_json)


for _word in _Topics.extensions:
    app.command(_word, context_settings=ANY_ARGUMENTS)(placeholder)


def answers_of(sockets: Sequence[Path], *, is_host: bool, is_needed: bool = True) -> tuple[Found, list[NodeTopics]]:
    """Return the running nodes and what they carry; exit 3 where none runs, and warn of those that do not answer."""
    from gdp.management.running_nodes import find_running_nodes, read_topics

    found = find_running_nodes(sockets, is_host=is_host)
    answers = read_topics(found)
    for problem in found.problems:
        echo(f"gdp: left out: {problem}", err=True)
    if not answers and is_needed:
        raise none_runs()
    for answer in answers:
        if answer.left_out:
            echo(f"gdp: {answer.node.label}: {answer.left_out} names with fewer messages left out", err=True)
    return found, answers


def none_runs() -> typer.Exit:
    """Report that no node runs that could answer; return the end of the command, with exit code 3."""
    echo(
        "error: no switch or proxy runs on this machine, as far as this user may see; start one, or use sudo", err=True
    )
    return typer.Exit(_NOT_RUNNING)


def _measured(seconds: float, sockets: Sequence[Path], node: Path | None, *, is_host: bool) -> list[RatedRow]:
    from gdp.management.running_nodes import read_topics
    from gdp.management.topic_rates import rated_rows

    held = [] if node is None else [_held_by(node)]
    found, before = answers_of(sockets, is_host=is_host, is_needed=not held)
    time.sleep(seconds if before else 0)  # the time over which the rates are measured
    now = read_topics(found)
    running = {answer.node.name for answer in now}
    now += [each for each in held if each.node.name not in running]
    return sorted(rated_rows(before, now), key=lambda row: (row.topic, row.node.role, row.node.name))


def _held_by(node: Path) -> NodeTopics:
    """Return what a node's delegations are about.

    Raises:
        LocalError: the node does not exist, or its files are wrong.
    """
    from gdp.crypto.certificates import Role
    from gdp.management.running_nodes import NodeTopics, RunningNode
    from gdp.nodes.delegation_store import DelegationStore
    from gdp.nodes.membership import load_member
    from gdp.session.settings import settings_of
    from gdp.state.topic_rows import held_row

    settings = settings_of(node)
    identity, _ = load_member(settings.identity, settings.domain, Role.PROXY)
    rows = [held_row(topic) for topic in DelegationStore(settings.delegation_directory, identity)]
    return NodeTopics(RunningNode(node, identity.role.value, identity.name), time.monotonic(), rows)


def _fits(row: RatedRow, name: str, type_name: str) -> bool:
    if type_name and row.type != type_name:
        return False
    lowered = name.lower().replace("...", "…")
    return name == row.topic or lowered in (row.row.name, Name.from_text(row.row.name).short)


def _cells(row: RatedRow) -> tuple[str, ...]:
    counts = row.row.publishers, row.row.readers
    return (
        row.topic,
        row.type or "-",
        row.row.direction.value,
        short_count(row.messages_s, ".1f"),
        bits(row.bits_s),
        short_count(row.size_bytes),
        *map(short_count, counts),
        row.node.label,
    )


def _described(row: RatedRow) -> dict[str, object]:
    fields = row.to_fields()
    for key in ("lost_since", "late_since"):
        del fields[key]
    fields["bits_s"] = bits(row.bits_s)
    fields["node"] = f"{row.node.role} {fields['node']}"
    del fields["role"]
    return {key: value for key, value in fields.items() if value not in ("", None)}
