"""Command ``gdp foxglove``."""

from __future__ import annotations

from gdp.cli.node import Logs, running
from gdp.cli.program import Program
from gdp_extensions.doors.command import DoorNode, DoorOptions, Listen, Origins, serve_door

app = Program("gdp foxglove")

LISTEN = "127.0.0.1:8765"


@app.command(epilog="Example: gdp foxglove keys/viewer --origin https://app.foxglove.dev")
def foxglove(
    node: DoorNode,
    listen: Listen = LISTEN,
    origin: Origins = [],  # noqa: B006  # typer copies it
    *,
    options: DoorOptions,
    logs: Logs,
) -> None:
    """Let Foxglove see what this node's delegations allow: a WebSocket server of the Foxglove protocol, until Ctrl-C.

    Topics that it may read are channels, services that it may call are services. Clients publish what it may publish.
    """
    with running(logs):
        from gdp_extensions.doors.core.foxglove_protocol import SUBPROTOCOLS
        from gdp_extensions.doors.core.foxglove_session import FoxgloveSession

        serve_door(
            "foxglove",
            lambda hub, number, queue: FoxgloveSession(hub, number, "gdp", queue),
            node,
            listen,
            origin,
            options,
            subprotocols=SUBPROTOCOLS,
        )
