"""Command ``gdp-proxy``.

I/O. It imports only the modules of the requested function: imports take most of the start-up time.
"""

from __future__ import annotations

import json
from typing import Annotated

import typer

from gdp.cli.node import AwaitIface, Check, Config, Json, Verbose, failing_clearly, set_up_logging
from gdp.cli.version import Version
from gdp.nodes.uplink import wait_for_device
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


@app.command(epilog="Example: gdp-proxy --config proxy.yaml --check")
def proxy(
    config: Config,
    await_iface: AwaitIface = 0.0,
    check: Check = False,
    json: Json = False,
    verbose: Verbose = False,
    schema: Schema = False,
    version: Version = False,
) -> None:
    """Carry what the configuration names between ROS and the overlay, until Ctrl-C; SIGHUP reads it again.

    With a ros section it takes part in that graph; without one it records what it imports.
    """
    del schema, version  # their callbacks end the command
    set_up_logging(verbose=verbose)
    with failing_clearly():
        settings = ProxyConfig.load(config)
        if check:
            from proxy.check.command import check_proxy

            if not settings.ros:
                from proxy.node.recorder import refuse_existing_file

                refuse_existing_file(settings)
            check_proxy(settings, json=json)
            return
        if settings.ros:
            from proxy.node.bridge_node import run

            wait_for_device(settings.iface, await_iface)
            run(config, settings, json=json)
        else:
            from proxy.node.recorder import record

            wait_for_device(settings.iface, await_iface)
            record(settings, json=json)


def main() -> None:
    """Run the command."""
    app(prog_name="gdp-proxy")


if __name__ == "__main__":
    main()
