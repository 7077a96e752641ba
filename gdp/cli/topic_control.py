"""``gdp control``: who holds the control of a topic, and who is to hold it.

I/O; over the control socket of a node of this machine, which asks the readers of the topic as the member that it is.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated, Final, NamedTuple

import typer

from gdp.cli import options
from gdp.cli.local_nodes import Node, connect, find_name
from gdp.cli.output import show, table
from gdp.cli.program import Program
from gdp.control import topic_control as control
from gdp.errors import LocalError
from gdp.intervals import ANSWER_S
from gdp.management.control_client import NodeConnection
from gdp.terminal import echo

app = Program("gdp control", no_args_is_help=True, help="Control of a topic that one publisher at a time may steer.")

_REFUSED: Final = 1
_COLUMNS: Final = ("at", "state", "holder", "refused")

NameText = Annotated[
    str, typer.Argument(metavar="NAME", help="A ROS name that a proxy of this machine carries, or 64 hex digits.")
]


@app.command("show", no_args_is_help=True, epilog="Example: gdp control show /cmd_vel")
def show_control(name: NameText, node: Node = None, as_json: options.Json = False) -> None:
    """Show who holds the control of a topic at each machine that reads it, and how many messages it has refused."""
    with connect(node) as connection:
        _print(_Readers.find(connection, name), as_json=as_json)


@app.command(no_args_is_help=True, epilog="Examples: gdp control take /cmd_vel; gdp control take /cmd_vel --force")
def take(
    name: NameText,
    force: Annotated[bool, typer.Option("--force", help="Also from another publisher that holds it.")] = False,
    node: Node = None,
    as_json: options.Json = False,
) -> None:
    """Take the control of a topic that this machine publishes, at each machine that reads it.

    The exit code is 1 if a reader refuses: another publisher holds control, or no right to publish is known there.
    """
    with connect(node) as connection:
        readers = _Readers.find(connection, name)
        _print(readers.act(control.TAKE, force=force, at=time.time_ns()), as_json=as_json)


@app.command(no_args_is_help=True, epilog="Examples: gdp control give /cmd_vel desk2; gdp control give /cmd_vel")
def give(
    name: NameText,
    to: Annotated[str, typer.Argument(metavar="[NODE]", help="Label of another publisher; default: none.")] = "",
    node: Node = None,
    as_json: options.Json = False,
) -> None:
    """Give the control of a topic to another publisher, or to none: the reader then publishes its message of stop.

    The holder may do so, and the machine that reads the topic.
    """
    with connect(node) as connection:
        _print(_Readers.find(connection, name).act(control.GIVE, to=to), as_json=as_json)


class _Readers(NamedTuple):
    """Readers of a topic that have it under exclusive control, with their answers by name."""

    connection: NodeConnection
    name: str
    answers: Mapping[str, Mapping[str, object]]

    @classmethod
    def find(cls, connection: NodeConnection, text: str) -> _Readers:
        """Return those of a name. Raises ``LocalError``: there are none."""
        name = find_name(text, connection).to_text()
        peers = [str(row["peer"]) for row in connection.show("peers") if (row["name"], row["is"]) == (name, "reader")]
        asked = dict.fromkeys([*peers, str(connection.status().get("name"))])
        readers = cls(connection, name, {})._ask({target: {} for target in asked})
        if not readers.answers:
            raise LocalError(f"{text}: {control.NO_READER}")
        return readers

    def act(self, act: str, **arguments: object) -> _Readers:
        """Ask each reader to act on what it has just said, and return the answers."""
        answers = self.answers.items()
        return self._ask({target: control.request(act, answer, **arguments) for target, answer in answers})

    def _ask(self, bodies: Mapping[str, Mapping[str, object]]) -> _Readers:
        common = {"name": self.name, "timeout_s": ANSWER_S, "reply_bytes": control.REPLY_BYTES}
        requests = [(control.ASK, {**common, "target": target, "body": body}) for target, body in bodies.items()]
        answers = dict(self.answers)
        for target, reply in zip(bodies, self.connection.ask_all(requests), strict=True):
            result = reply.get("result")
            if isinstance(result, Mapping) and control.has_control(result):
                answers[target] = {"at": reply.get("label"), **result}
            elif target in answers:
                answers[target] = {**answers[target], "error": reply.get("error") or control.NO_ANSWER}
        return self._replace(answers=answers)


def _print(readers: _Readers, *, as_json: bool) -> None:
    rows = list(readers.answers.values())
    show({"name": readers.name, "readers": rows}, as_json=as_json, plain=table(rows, _COLUMNS))
    errors = [f"{row['at']}: {row['error']}" for row in rows if row["error"]]
    for text in errors:
        echo(f"error: {text}", err=True)
    if errors:
        raise typer.Exit(_REFUSED)
