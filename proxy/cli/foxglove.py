"""Command ``gdp foxglove``.

I/O; ``gdp`` starts it, since the package ``gdp`` does not know ``proxy``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from gdp.cli.node import AwaitIface, Format, Json, Level, LogFormat, LogLevel, Verbose, failing_clearly, set_up_logging
from gdp.cli.version import HELP, Version, versioned
from gdp.links.uplink import wait_for_device
from proxy.cli.door_token import NoToken, TokenFile, door_token
from proxy.cli.node_options import Delegations, DoorNode, Iface, Listen

__all__ = ["main"]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

LISTEN = "127.0.0.1:8765"

Origins = Annotated[
    list[str],
    typer.Option(
        "--origin",
        metavar="URL",
        help="Let pages of this origin connect, such as https://app.foxglove.dev.",
    ),
]


@app.command(context_settings=HELP, epilog="Example: gdp foxglove keys/viewer --origin https://app.foxglove.dev")
def foxglove(
    node: DoorNode,
    listen: Listen = LISTEN,
    origin: Origins = [],  # noqa: B006  # typer copies it
    token_file: TokenFile = None,
    no_token: NoToken = False,
    iface: Iface = None,
    delegations: Delegations = None,
    await_iface: AwaitIface = 0.0,
    json: Json = False,
    verbose: Verbose = False,
    log_level: LogLevel = Level.INFO,
    log_format: LogFormat = Format.TEXT,
    version: Version = False,
) -> None:
    """Let Foxglove see what this node's delegations allow: a WebSocket server of the Foxglove protocol, until Ctrl-C.

    Topics that it may read are channels, services that it may call are services. Clients publish what it may publish.
    """
    del version  # its callback ends the command
    set_up_logging(verbose=verbose, level=log_level, form=log_format)
    with failing_clearly():
        from proxy.doors.foxglove_protocol import SUBPROTOCOLS
        from proxy.doors.foxglove_session import FoxgloveSession
        from proxy.endpoints.door import DoorEndpoint, DoorSettings
        from proxy.node.door import door_config, run_door

        config, _ = door_config(node, iface, delegations)
        token = door_token(token_file, no_token=no_token)
        settings = DoorSettings(
            label="foxglove", listen=listen, origins=tuple(origin), subprotocols=SUBPROTOCOLS, token=token
        )
        wait_for_device(config.iface, await_iface)
        run_door(
            config,
            lambda rights: DoorEndpoint(
                settings, lambda hub, number, queue: FoxgloveSession(hub, number, "gdp", queue), rights
            ),
            json=json,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; ``arguments``: by default those of this process."""
    versioned(app)(args=None if arguments is None else list(arguments), prog_name="gdp foxglove")


if __name__ == "__main__":
    main()
