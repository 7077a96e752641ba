"""``fog`` command: clusters of replicated ROS services on machines that may be preempted.

I/O; each verb is a function of another module. Exit status: 0 done, 2 wrong input, 130 after Ctrl-C.
"""

from __future__ import annotations

from collections.abc import Sequence

import typer

from fog.cli import scale, status
from fog.cli.down import down
from fog.cli.launch import launch
from fog.cli.logs import logs
from fog.cli.plan import cost_table, plan
from fog.cli.wheels import wheels_command
from fog.providers.local.cli import local_app
from fog.site import open_site
from gdp.cli.completion import allow_completion
from gdp.cli.version import HELP, Version, versioned

__all__ = ["app", "main"]


app = typer.Typer(
    name="fog",
    help="Replicated ROS services on machines that may be taken away.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings=HELP,
)
app.command("launch")(launch)
app.command("ls")(status.ls)
app.command("status")(status.status)
app.add_typer(scale.scale, name="scale")
app.command("push")(scale.push)
app.command("logs")(logs)
app.command("ssh")(scale.ssh)
app.command("cost")(status.cost)
app.command("plan")(plan)
app.command("prices")(cost_table)
app.command("down")(down)
app.command("wheels")(wheels_command)
app.command("supervise")(scale.supervise)
app.add_typer(local_app(lambda: open_site(None).state / "local"), name="local")


@app.callback()
def _fog(version: Version = False) -> None:
    del version  # the option's callback ends the command


def main(arguments: Sequence[str] | None = None, *, name: str = "fog") -> None:
    """Run the command and exit with its status."""
    allow_completion(name)
    versioned(app)(args=None if arguments is None else list(arguments), prog_name=name)


if __name__ == "__main__":
    main()
