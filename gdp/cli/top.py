"""``gdp top``: live rates of the names that this machine's nodes carry."""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gdp.cli.options import Host
from gdp.cli.output import show
from gdp.cli.tables import bits, columns, short_count
from gdp.cli.topic import JsonLines, Sockets, answers_of
from gdp.management.running_nodes import find_running_nodes, read_topics
from gdp.management.topic_rates import RatedRow, rated_rows
from gdp.printable import escaped
from gdp.state.topic_rows import Direction
from gdp.terminal import echo

if TYPE_CHECKING:
    from rich.table import Table

_HEAD: Final = ("NAME", "DIRECTION", "MSG/S", "RATE", "LOST", "LATE", "PUBLISHERS", "READERS", "NODE")
_FIND_EVERY: Final = 5  # redraws between two searches for nodes that have started
_BORDER_LINES: Final = 8  # of a terminal, that the table's frame and its texts take


def top(
    once: Annotated[bool, typer.Option("--once", help="Measure once, print lines, and end.")] = False,
    interval: Annotated[float, typer.Option(min=0.1, metavar="SECONDS", help="Time between two redraws.")] = 1.0,
    count: Annotated[int | None, typer.Option("-n", "--count", min=1, help="End after so many redraws.")] = None,
    socket: Sockets = [],  # noqa: B006  # typer copies it
    host: Host = False,
    as_json: JsonLines = False,
) -> None:
    """Show the live rates of the names that this machine's proxies and switches carry, busiest first, until Ctrl-C.

    LOST and LATE are counts since the redraw before; --json has the totals as well. Rows of a switch count frames, as
    far as its data plane counts them by name. In a pipe it prints plain lines instead of a table.

    \b
    Examples:
      gdp top
      gdp top --once
      gdp top --json -n 10
    """
    answers_of(socket, is_host=host)  # exits where nothing runs
    rounds = itertools.islice(_measured(interval, socket, is_host=host), 1 if once else count)
    with contextlib.suppress(KeyboardInterrupt):
        if as_json:
            _print_json(rounds)
        elif once or not sys.stdout.isatty():
            _print_lines(rounds)
        else:
            _draw(rounds)


def _measured(interval_s: float, sockets: Sequence[Path], *, is_host: bool) -> Iterator[list[RatedRow]]:
    """Yield the rows of each interval, busiest first."""
    found = find_running_nodes(sockets, is_host=is_host)
    before = read_topics(found)
    for number in itertools.count(1):
        time.sleep(interval_s)  # the time over which the rates are measured
        if number % _FIND_EVERY == 0:
            found = find_running_nodes(sockets, is_host=is_host)
        now = read_topics(found)
        rows = [row for row in rated_rows(before, now) if row.row.direction is not Direction.HELD]
        before = now
        yield sorted(rows, key=lambda row: (-(row.bits_s or 0.0), -(row.messages_s or 0.0), row.topic))


def _cells(row: RatedRow) -> tuple[str, ...]:
    return (
        row.topic,
        row.row.direction.value,
        short_count(row.messages_s, ".1f"),
        bits(row.bits_s),
        short_count(row.lost),
        short_count(row.late),
        short_count(row.row.publishers),
        short_count(row.row.readers),
        row.node.label,
    )


def _print_json(rounds: Iterator[list[RatedRow]]) -> None:
    for rows in rounds:
        at_unix_s = round(time.time(), 3)
        for row in rows:
            show({"at_unix_s": at_unix_s, **row.to_fields()}, as_json=True)
        sys.stdout.flush()


def _print_lines(rounds: Iterator[list[RatedRow]]) -> None:
    for number, rows in enumerate(rounds):
        if number:
            echo()
        for line in columns(_HEAD, [_cells(row) for row in rows]):
            echo(line)
        sys.stdout.flush()


def _draw(rounds: Iterator[list[RatedRow]]) -> None:
    from rich.console import Console
    from rich.live import Live

    console = Console()
    with Live(_table([], 0), console=console, screen=True, auto_refresh=False) as live:
        for rows in rounds:
            live.update(_table(rows, max(console.height - _BORDER_LINES, 1)), refresh=True)


def _table(rows: Sequence[RatedRow], space: int) -> Table:
    """Return the table of the busiest rows that the terminal has lines for, and the number of the others."""
    from rich.table import Table
    from rich.text import Text

    clock = datetime.now(timezone.utc).strftime("%H:%M:%S UTC")
    hidden = max(len(rows) - space, 0)
    more = f"{hidden} more; 'gdp top --once' shows all. " if hidden else ""
    drawn = Table(title=f"gdp top  {clock}", caption=f"{more}Ctrl-C ends.", title_justify="left", expand=True)
    for at, heading in enumerate(_HEAD):
        drawn.add_column(heading, no_wrap=True, justify="right" if 2 <= at <= 7 else "left")
    for row in rows[:space]:
        drawn.add_row(*(Text(escaped(each)) for each in _cells(row)), style="red" if row.lost or row.late else None)
    return drawn
