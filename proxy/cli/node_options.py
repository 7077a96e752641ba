"""Options that commands share which act as one node.

I/O-free; typer reads these annotations at run time, on Python 3.10 too: hence Optional.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from gdp.cli.completion import complete_node

__all__ = ["Delegations", "DoorNode", "Iface", "Listen"]

Iface = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--iface", metavar="DEVICE", help="Device towards the switch. Default: as the node says."),
]
Delegations = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--delegations", metavar="DIR", help="What owners gave the node. Default: as the node says."),
]
DoorNode = Annotated[
    Path,
    typer.Argument(
        metavar="NODE", autocompletion=complete_node, help="The door's own node: its directory, or its proxy.yaml."
    ),
]
Listen = Annotated[str, typer.Option("--listen", metavar="HOST:PORT", help="Where clients connect.")]
