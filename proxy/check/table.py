"""Table of the findings of ``gdp-proxy --check``, followed by faults and notes that are ready to copy.

I/O layer; it builds rich renderables and prints nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.console import Group
from rich.table import Table
from rich.text import Text

from gdp.printable import escaped
from proxy.check.core.finding import Finding, Match

__all__ = ["table"]


def table(findings: Sequence[Finding]) -> Group:
    """Return one row for each name under each rule, then one line for each fault and note."""
    drawn = Table(title="rules", title_justify="left", title_style="bold")
    for heading in ("rule", "here", "type", "nodes", "QoS"):
        drawn.add_column(heading, overflow="fold")
    for heading in ("name", "allowed"):
        drawn.add_column(heading, overflow="fold")
    for finding in findings:
        rule = Text(f"{finding.direction} {finding.kind} {finding.name}")
        if not finding.matches:
            drawn.add_row(rule, "-", style="dim")
        for match in finding.matches:
            drawn.add_row(rule, *(Text(escaped(each)) for each in _cells(match)), style=_style(match))
    return Group(drawn, *_lines(findings))


def _cells(match: Match) -> tuple[str, ...]:
    return (
        match.local,
        match.type_name or "?",
        "\n".join(match.nodes) or "-",
        "\n".join(match.qos) or "-",
        match.overlay.short if match.overlay is not None else "-",
        "yes" if match.is_held else "no",
    )


def _style(match: Match) -> str | None:
    return "red" if match.faults else None if match.nodes else "dim"


def _lines(findings: Sequence[Finding]) -> Iterator[Text]:
    for finding in findings:
        for match in finding.matches:
            for text in match.faults:
                yield Text(f"{finding.direction} {match.local}: {text}", style="red")
            for text in match.notes:
                yield Text(f"{finding.direction} {match.local}: {text}")
        for text in finding.notes:
            yield Text(f"{finding.direction} {finding.name}: {text}")
