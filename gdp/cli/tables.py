"""Tables on the standard output: columns as wide as their content, and numbers for people.

I/O. Outside a terminal no cell is shortened and no line is wrapped.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence

from gdp.errors import LocalError
from gdp.names import NAME_BYTES, Name
from gdp.terminal import echo

_HEX_DIGITS = 2 * NAME_BYTES
_LAST = "…"
_CUT_MIN = 24  # a column is cut only where so much of it is shown


def select_columns(rows: Sequence[Mapping[str, object]], columns: str | None) -> list[str]:
    """Return the columns to print: those of an option, or all.

    Raises:
        LocalError: the option names one that the table does not have.
    """
    known = list(dict.fromkeys(key for row in rows for key in row))
    if columns is None:
        return known
    wanted = [each.strip() for each in columns.split(",")]
    unknown = [each for each in wanted if each not in known]
    if unknown and rows:
        raise LocalError(f"--columns: no column {unknown[0]!r}; the table has {', '.join(known)}")
    return wanted


def print_table(rows: Sequence[Mapping[str, object]], columns: Sequence[str]) -> None:
    """Print rows under their column names.

    On a terminal, names are short, and columns that do not fit are left out and named; elsewhere everything is whole.
    """
    is_terminal = sys.stdout.isatty()
    cells = [[cell(row.get(column), is_short=is_terminal) for column in columns] for row in rows]
    widths = [max(map(len, (column, *(line[at] for line in cells)))) for at, column in enumerate(columns)]
    width = shutil.get_terminal_size().columns if is_terminal else 0
    shown = _fitting(widths, width) if width else len(columns)
    for line in [[column.upper() for column in columns], *cells]:
        text = "  ".join(word.ljust(size) for word, size in zip(line[:shown], widths[:shown], strict=True)).rstrip()
        echo(text if not width or len(text) <= width else text[: width - 1] + _LAST)
    if left_out := columns[shown:]:
        echo(f"gdp: left out, too wide: {', '.join(left_out)}; --columns chooses, a pipe has all", err=True)


def _fitting(widths: Sequence[int], width: int) -> int:
    """Return how many columns fit, the first in any case; one that is long, such as a text, may be cut."""
    taken = 0
    for at, size in enumerate(widths):
        if at and taken + min(size, _CUT_MIN) > width:
            return at
        taken += size + len("  ")
    return len(widths)


def cell(value: object, *, is_short: bool) -> str:
    """Return a value as text; ``is_short``: names in their form for people."""
    if value is None or value == "":
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    text = str(value)
    if is_short and len(text) == _HEX_DIGITS and set(text) <= set("0123456789abcdef"):
        return Name.from_text(text).short
    return text


def columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return one line for the head and one for each row, each column as wide as its widest cell."""
    table = [head, *rows]
    widths = [max(len(row[at]) for row in table) for at in range(len(head))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table]


def bits(bits_s: float | None) -> str:
    """Return a rate for people, such as ``1.20 Mbit/s``; ``-``: unknown."""
    if bits_s is None:
        return "-"
    for unit, word in ((1e9, "Gbit/s"), (1e6, "Mbit/s"), (1e3, "kbit/s")):
        if bits_s >= unit:
            return f"{bits_s / unit:.2f} {word}"
    return f"{bits_s:.0f} bit/s"


def short_count(value: float | None, form: str = ".0f") -> str:
    """Return a number for people; ``-``: unknown."""
    return "-" if value is None else f"{value:{form}}"
