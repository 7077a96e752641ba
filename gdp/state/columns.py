"""Columns of text that are as wide as their content: nothing is cut, in a terminal or in a pipe."""

from __future__ import annotations

from collections.abc import Sequence


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
