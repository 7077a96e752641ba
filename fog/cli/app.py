"""``fog`` command: clusters of replicated ROS services on machines that may be preempted.

I/O; each verb is a function of another module. Exit status: 0 done, 2 wrong input, 130 after Ctrl-C.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
from typing import Annotated

import typer

from fog.cli import scale, status
from fog.cli.down import down
from fog.cli.launch import launch
from fog.cli.plan import cost_table, plan
from fog.cli.wheels import wheels_command
from fog.providers.local.cli import local_app
from fog.site import open_site

__all__ = ["app", "main"]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fog {metadata.version('gdp-ros')}")
        raise typer.Exit


app = typer.Typer(
    name="fog",
    help="Replicated ROS services on machines that may be taken away.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("launch")(launch)
app.command("ls")(status.ls)
app.command("status")(status.status)
app.add_typer(scale.scale, name="scale")
app.command("logs")(scale.logs)
app.command("ssh")(scale.ssh)
app.command("cost")(status.cost)
app.command("plan")(plan)
app.command("prices")(cost_table)
app.command("down")(down)
app.command("wheels")(wheels_command)
app.command("supervise")(scale.supervise)
app.add_typer(local_app(lambda: open_site(None).state / "local"), name="local")


@app.callback()
def _fog(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="print the version and end")
    ] = False,
) -> None:
    del version


def main(arguments: Sequence[str] | None = None, *, name: str = "fog") -> None:
    """Run the command and exit with its status."""
    app(args=None if arguments is None else list(arguments), prog_name=name)


if __name__ == "__main__":
    main()
