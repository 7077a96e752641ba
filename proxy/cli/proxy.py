"""Command ``gdp-proxy``.

I/O. It imports only the modules of the requested function: imports take most of the start-up time.
"""

from __future__ import annotations

import json
from typing import Annotated

import typer

from gdp.cli.console import Columns
from gdp.cli.node import AwaitIface, Check, Config, Json, Logs, MemberPlane, running, with_plane
from gdp.cli.program import Program
from gdp.intervals import ATTACH_S

app = Program("gdp-proxy")
main = app.run


def schema_text() -> str:
    """Return the content of ``docs/proxy.schema.json``."""
    from proxy.config.config import ProxyConfig

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
    await_iface: AwaitIface = ATTACH_S,
    data_plane: MemberPlane = None,
    check: Check = False,
    columns: Columns = None,
    json: Json = False,
    *,
    logs: Logs,
    schema: Schema = False,
) -> None:
    """Carry what the configuration names between ROS and the overlay, until Ctrl-C; SIGHUP reads it again.

    With a ros section it takes part in that graph; without one it records what it imports. Exit 1: not all that came
    could be written.
    """
    del columns, schema  # their callbacks have done all
    from gdp.links.uplink import wait_for_device
    from proxy.config.config import ProxyConfig

    with running(logs):
        settings = with_plane(ProxyConfig.load(config), data_plane)
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


if __name__ == "__main__":
    main()
