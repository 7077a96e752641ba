"""Console for tables: as wide as its terminal, as wide as ``--columns`` says, or in a pipe as wide as its content.

I/O. A program that reads a pipe needs whole lines, so nothing is wrapped or cut there.
"""

from __future__ import annotations

from contextvars import ContextVar
from typing import TYPE_CHECKING, Annotated, Final

import typer

if TYPE_CHECKING:  # a node starts without this library
    from rich.console import Console
    from rich.table import Table

_PIPE_COLUMNS: Final = 10_000
_COLUMNS_MIN: Final = 20

_chosen: ContextVar[int | None] = ContextVar("columns", default=None)


def _choose(columns: int | None) -> int | None:
    _chosen.set(columns)
    return columns


Columns = Annotated[
    int | None,
    typer.Option(
        "--columns",
        metavar="N",
        min=_COLUMNS_MIN,
        callback=_choose,
        help="Width of tables. Default: the terminal's; in a pipe whole lines.",
    ),
]


def console(*, stderr: bool = False) -> Console:
    """Return a console of the width that the command's ``--columns`` or its output needs."""
    from rich.console import Console

    made = Console(stderr=stderr, highlight=False)
    if (columns := _chosen.get()) is not None:
        made.width = columns
    elif not made.is_terminal:
        made.width = _PIPE_COLUMNS
    return made


def folding(table: Table) -> Table:
    """Let cells that are too wide continue on the next line, where rich would cut them off; return the table."""
    for column in table.columns:
        column.overflow = "fold"
    return table
