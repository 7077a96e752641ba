"""The ``fog`` command: clusters of replicated ROS services on machines that may be taken away.

Place: command; each verb has its function elsewhere. Exit 0 when done, 2 when the input is wrong, 130 after Ctrl-C.
"""

from __future__ import annotations

from collections.abc import Sequence

import typer

from fog.cli import changing, looking
from fog.cli.ending import down
from fog.cli.launching import launch
from fog.cli.plan import cost_table, plan
from fog.providers.local.cli import local_app
from fog.site import open_site

__all__ = ["app", "main"]

app = typer.Typer(
    name="fog",
    help="Replicated ROS services on machines that may be taken away.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command("launch", no_args_is_help=True)(launch)
app.command("ls")(looking.ls)
app.command("status")(looking.status)
app.add_typer(changing.scale, name="scale")
app.command("logs", no_args_is_help=True)(changing.logs)
app.command("ssh", no_args_is_help=True)(changing.ssh)
app.command("cost")(looking.cost)
app.command("plan", no_args_is_help=True)(plan)
app.command("prices")(cost_table)
app.command("down")(down)
app.command("supervise")(changing.supervise)
app.add_typer(local_app(lambda: open_site(None).state / "local"), name="local", hidden=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and leave with its exit code.

    Args:
        arguments: as after the program's name; those of this process if not given.
    """
    app(args=None if arguments is None else list(arguments), prog_name="fog")


if __name__ == "__main__":
    main()
