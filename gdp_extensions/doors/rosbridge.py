"""Command ``gdp rosbridge``."""

from __future__ import annotations

import secrets
import time

from gdp.cli.node import Logs, running
from gdp.cli.program import Program
from gdp_extensions.doors.command import DoorNode, DoorOptions, Listen, Origins, serve_door

app = Program("gdp rosbridge")

LISTEN = "127.0.0.1:9090"


@app.command(epilog="Example: gdp rosbridge keys/viewer --origin http://localhost:8000")
def rosbridge(
    node: DoorNode,
    listen: Listen = LISTEN,
    origin: Origins = [],  # noqa: B006  # typer copies it
    *,
    options: DoorOptions,
    logs: Logs,
) -> None:
    """Let roslibjs, roslibpy and others use what this node's delegations allow: a rosbridge v2 server, until Ctrl-C.

    Clients subscribe to what it may read, call what it may call, and publish what it may publish.
    """
    with running(logs):
        from gdp_extensions.doors.core.rosbridge_session import RosbridgeSession

        serve_door(
            "rosbridge",
            lambda hub, number, queue: RosbridgeSession(
                hub, number, queue, time.monotonic, lambda: secrets.token_bytes(16)
            ),
            node,
            listen,
            origin,
            options,
        )
