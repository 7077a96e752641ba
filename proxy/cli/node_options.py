"""Options that commands share which act as one node.

I/O-free; typer reads these annotations at run time, on Python 3.10 too: hence Optional.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

__all__ = ["Delegations", "Iface"]

Iface = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option("--iface", metavar="DEVICE", help="Device towards the switch. Default: as the node says."),
]
Delegations = Annotated[
    Optional[Path],  # noqa: UP045
    typer.Option("--delegations", metavar="DIR", help="What owners gave the node. Default: as the node says."),
]
