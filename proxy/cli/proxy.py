"""Command ``gdp-proxy``.

I/O. It imports only the modules of the requested function: imports take most of the start-up time.
"""

from __future__ import annotations

import json
from typing import Annotated

import typer

from gdp.cli.completion import allow_completion
from gdp.cli.console import Columns
from gdp.cli.node import (
    AWAIT_IFACE_S,
    AwaitIface,
    Check,
    Config,
    Format,
    Json,
    Level,
    LogFormat,
    LogLevel,
    MemberPlane,
    Verbose,
    failing_clearly,
    member_plane,
    set_up_logging,
)
from gdp.cli.version import HELP, Version, versioned
from gdp.links.uplink import wait_for_device
from proxy.config.config import ProxyConfig

__all__ = ["Schema", "main", "schema_text"]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def schema_text() -> str:
    """Return the content of ``docs/proxy.schema.json``."""
    return json.dumps(ProxyConfig.json_schema(), indent=2) + "\n"


def _print_and_end(wanted: bool) -> None:
    if wanted:
        typer.echo(schema_text(), nl=False)
        raise typer.Exit


Schema = Annotated[
    bool,
    typer.Option(
        "--schema",
        is_eager=True,
        callback=_print_and_end,
        help="Print the JSON schema of the configuration, for editors, and end.",
    ),
]


@app.command(context_settings=HELP, epilog="Example: gdp-proxy --config proxy.yaml --check")
def proxy(
    config: Config,
    await_iface: AwaitIface = AWAIT_IFACE_S,
    data_plane: MemberPlane = None,
    check: Check = False,
    columns: Columns = None,
    json: Json = False,
    verbose: Verbose = False,
    log_level: LogLevel = Level.INFO,
    log_format: LogFormat = Format.TEXT,
    schema: Schema = False,
    version: Version = False,
) -> None:
    """Carry what the configuration names between ROS and the overlay, until Ctrl-C; SIGHUP reads it again.

    With a ros section it takes part in that graph; without one it records what it imports. Exit 1: not all that came
    could be written.
    """
    del columns, schema, version  # their callbacks have done all
    set_up_logging(verbose=verbose, level=log_level, form=log_format)
    with failing_clearly():
        settings = ProxyConfig.load(config)
        if data_plane is not None:
            settings = settings.model_copy(update={"data_plane": member_plane(data_plane)})
        if check:
            from proxy.check.command import check_proxy

            if not settings.ros:
                from proxy.node.recorder import refuse_existing_file

                refuse_existing_file(settings)
            raise typer.Exit(1 if check_proxy(config, settings, json=json) else 0)
        if settings.ros:
            from proxy.node.bridge_node import run

            wait_for_device(settings.iface, await_iface)
            run(config, settings, json=json)
        else:
            from proxy.node.recorder import record

            wait_for_device(settings.iface, await_iface)
            raise typer.Exit(0 if record(settings, json=json) else 1)


def main() -> None:
    """Run the command."""
    allow_completion("gdp-proxy")
    versioned(app)(prog_name="gdp-proxy")


if __name__ == "__main__":
    main()
