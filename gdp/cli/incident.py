"""``gdp incident``: the journal of a node, saved, shown and replayed.

I/O. Exit codes: 0 done, 1 the replay differs, 2 wrong input, 3 no node runs there.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli import options
from gdp.cli.local_nodes import connect
from gdp.cli.output import show
from gdp.cli.tables import print_table, select_columns
from gdp.errors import LocalError
from gdp.journal.incident import Incident
from gdp.journal.replay import Replay
from gdp.journal.summary import summary
from gdp.stores.files import private, write_all
from gdp.stores.keyring import load_node_keys
from gdp.terminal import echo

app = typer.Typer(no_args_is_help=True, help="What happened at a node: save its journal, show it, and run it again.")

File = Annotated[Path, typer.Argument(metavar="FILE", help="An incident that gdp incident save wrote.")]


@app.command("save")
def save(
    node: Annotated[str, typer.Argument(metavar="NODE", help="Its directory, label or control socket.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Default: NODE-TIME.incident.")
    ] = None,
    force: options.Force = False,
    as_json: options.Json = False,
) -> None:
    """Save the journal of a running switch or RIB that has the key journal in its configuration.

    The file has frames, which are sealed or signed, and certificates, but no key. What the node drew for its session
    keys is sealed to the node itself.

    \b
    Example:
      gdp incident save robot/switch -o /tmp/robot.incident
    """
    with connect(node) as connection:
        incident = Incident.from_blocks(*connection.journal()).sealed()
    path = output or Path(f"{incident.head['label']}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}.incident")
    write_all(path.parent, {path.name: private(incident.to_bytes())}, force=force)
    show({"file": str(path), "entries": len(incident.entries), "lost before": incident.head["first"]}, as_json=as_json)


@app.command("show")
def show_incident(file: File, as_json: options.Json = False) -> None:
    """Show what came, went and was lost, by neighbour, kind and name, and when.

    \b
    Example:
      gdp incident show robot.incident
      gdp incident show robot.incident --json | jq .neighbours
    """
    tables = summary(_read(file))
    if as_json:
        show(tables, as_json=True)
        return
    for title, rows in tables.items():
        echo(f"\n{title}" if title != "incident" else title)
        print_table(rows, select_columns(rows, None))


@app.command("replay")
def replay(
    file: File,
    keys: Annotated[
        Path | None,
        typer.Option("--keys", metavar="DIR", help="Directory of the node's keys, which open what it drew."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Run the node's core again in memory, and compare every frame that it sends; the exit code is 1 if one differs.

    \b
    Example:
      gdp incident replay robot.incident --keys robot/switch
    """
    incident = _read(file)
    if "drawn" in incident.head and keys is not None:
        incident = incident.opened(load_node_keys(keys).kem)
    run = Replay(incident)
    run.run()
    result = {"entries": run.at, **{f"sent {kind}": count for kind, count in sorted(run.sent.items())}}
    result |= {f"dropped {reason}": count for reason, count in run.drops().items()}
    show({**result, "difference": run.difference or "none"}, as_json=as_json)
    if run.difference:
        raise typer.Exit(1)


def _read(file: Path) -> Incident:
    try:
        return Incident.from_bytes(file.read_bytes())
    except OSError as error:
        raise LocalError(f"{file}: {error.strerror}") from error
    except LocalError as error:
        raise LocalError(f"{file}: {error}") from error
