"""Option ``--version`` of every command.

I/O.
"""

from __future__ import annotations

from typing import Annotated

import typer

import gdp

__all__ = ["Version"]


def _print_and_end(context: typer.Context, is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"{context.find_root().info_name} {gdp.__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", is_eager=True, callback=_print_and_end, help="Print the version and end.")
]
