"""Command ``gdp dashboard``: a live view of the nodes of this machine, as a page on the loopback address."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli import options
from gdp.cli.node import failing_clearly, report
from gdp.cli.program import Program

app = Program("gdp dashboard")

_PORT_MAX: Final = 65_535

Nodes = Annotated[
    list[Path] | None,
    typer.Option("--node", metavar="DIR", help="Directory of a node's keys; may be repeated. Default: all nodes here."),
]
States = Annotated[
    list[Path] | None,
    typer.Option("--state", metavar="DIR", help="State folder of fog, for its clusters; may be repeated."),
]
Port = Annotated[int, typer.Option(min=0, max=_PORT_MAX, help="Port of 127.0.0.1; 0: the system chooses.")]


@app.command()
def dashboard(node: Nodes = None, state: States = None, port: Port = 0, as_json: options.Json = False) -> None:
    """Show domains, switches, links, names, replicas, drops and events live, on one page, until Ctrl-C.

    The page is at 127.0.0.1 only, and its address holds a secret token. It asks the control sockets of the nodes once
    a second, so it needs the user of the nodes.

    \b
    Examples:
      gdp dashboard
      gdp dashboard --port 8600 --node robot/switch --node robot/proxy
      gdp dashboard --state ~/.local/state/gdp-fog --json
    """
    with failing_clearly():
        asyncio.run(_serve(tuple(node or ()), tuple(state or ()), port, as_json=as_json))


async def _serve(nodes: tuple[Path, ...], states: tuple[Path, ...], port: int, *, as_json: bool) -> None:
    from gdp_extensions.dashboard.poller import Poller
    from gdp_extensions.dashboard.server import DashboardServer

    server = DashboardServer(Poller(nodes, states), port)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)

    def ready() -> None:
        """Print the address."""
        found = len(server.scene.graph.nodes)
        none = "" if found else "\nno node runs here as far as this user may see; start one, or use sudo"
        text = f"live view of {found} nodes: {server.url}{none}"
        report("ready", text, json=as_json, url=server.url, nodes=found)

    await server.run_until(ready, stop)
