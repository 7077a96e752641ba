"""``gdp`` command: names, keys, trust domains, memberships and delegations.

I/O; each sub-command has a file of its own. Exit 0 when done, 2 when the input is wrong.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import typer

from gdp.cli import audit, cert, control, delegate, domain, key, keygen
from gdp.cli.endpoints import endpoints
from gdp.cli.join import agent, join, up
from gdp.cli.lab import lab
from gdp.cli.name import name
from gdp.cli.share import expose, import_names, share
from gdp.cli.version import Version
from gdp.errors import GdpError

__all__ = ["app", "main"]

app = typer.Typer(
    name="gdp",
    help="Names, keys and proofs of the Global Data Plane.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)


@app.callback()
def _gdp(version: Version = False) -> None:
    del version  # the option's callback ends the command


app.command("name", no_args_is_help=True)(name)
app.command("lab", no_args_is_help=True)(lab)
app.command("endpoints", no_args_is_help=True)(endpoints)
for member_command in (join, up, agent):
    app.command(member_command.__name__, no_args_is_help=True)(member_command)
app.command("expose", no_args_is_help=True)(expose)
app.command("import", no_args_is_help=True)(import_names)
app.command("share", no_args_is_help=True)(share)
for command in (control.reload, control.status, control.drain):
    app.command(command.__name__, no_args_is_help=True)(command)
app.add_typer(keygen.app, name="keygen")
app.add_typer(key.app, name="key")
app.add_typer(domain.app, name="domain")
app.add_typer(cert.app, name="cert")
app.add_typer(delegate.app, name="delegate")
app.add_typer(audit.app, name="audit")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit with its code.

    Args:
        arguments: as after the program's name; by default those of this process.
    """
    try:
        app(args=None if arguments is None else list(arguments), prog_name="gdp")
    except GdpError as error:
        typer.echo(f"gdp: {error}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
