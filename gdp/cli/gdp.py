"""``gdp`` command: names, keys, trust domains, memberships and delegations.

I/O; each sub-command has a file of its own. Exit 0 when done, 2 when the input is wrong.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import ClassVar

import typer

from gdp.cli import audit, cert, control, delegate, domain, doors, extension, key, keygen, rib_lookup, service, topic
from gdp.cli.completion import allow_completion, completion
from gdp.cli.dashboard import dashboard
from gdp.cli.decrypt_pcap import decrypt_pcap
from gdp.cli.demo import ANY_ARGUMENTS, demo
from gdp.cli.endpoints import endpoints
from gdp.cli.explain import explain
from gdp.cli.extension import ExtendedGroup
from gdp.cli.join import agent, join, up
from gdp.cli.lab import lab
from gdp.cli.name import name
from gdp.cli.ping import ping
from gdp.cli.share import expose, import_names, share
from gdp.cli.show_tables import show_table
from gdp.cli.top import top
from gdp.cli.trace import trace
from gdp.cli.version import HELP, Version, versioned
from gdp.cli.wireshark import wireshark
from gdp.errors import GdpError

__all__ = ["app", "main"]


class _Commands(ExtendedGroup):
    extensions: ClassVar[Mapping[str, str]] = {
        each: f"proxy.cli.{each}" for each in ("foxglove", "rosbridge", "rule", "watch")
    }


app = typer.Typer(
    name="gdp",
    cls=_Commands,
    help="Names, keys and proofs of the Global Data Plane.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings=HELP,
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
app.command("explain", no_args_is_help=True)(explain)
for door in (doors.foxglove, doors.rosbridge, doors.rule, doors.watch):
    app.command(door.__name__, context_settings=extension.ANY_ARGUMENTS)(door)
app.command("ping", no_args_is_help=True)(ping)
app.command("trace", no_args_is_help=True)(trace)
app.command("show", no_args_is_help=True)(show_table)
app.command("dashboard")(dashboard)
app.command("wireshark")(wireshark)
app.command("demo", context_settings=ANY_ARGUMENTS)(demo)
app.command("decrypt-pcap", no_args_is_help=True)(decrypt_pcap)
app.add_typer(keygen.app, name="keygen")
app.add_typer(key.app, name="key")
app.add_typer(domain.app, name="domain")
app.add_typer(cert.app, name="cert")
app.add_typer(delegate.app, name="delegate")
app.add_typer(audit.app, name="audit")
app.add_typer(topic.app, name="topic")
app.add_typer(service.app, name="service")
app.add_typer(rib_lookup.app, name="rib")
app.command("top")(top)
app.command("completion", no_args_is_help=True)(completion)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit with its code.

    Args:
        arguments: as after the program's name; by default those of this process.
    """
    allow_completion("gdp")
    try:
        versioned(app)(args=None if arguments is None else list(arguments), prog_name="gdp")
    except GdpError as error:
        typer.echo(f"gdp: {error}", err=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
