"""Options that commands share which act as one node."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Iface = Annotated[
    str | None, typer.Option("--iface", metavar="DEVICE", help="Device towards the switch. Default: as the node says.")
]
Delegations = Annotated[
    Path | None,
    typer.Option("--delegations", metavar="DIR", help="What owners gave the node. Default: as the node says."),
]
