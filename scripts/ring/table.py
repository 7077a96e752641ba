"""Table at the end of a run. I/O layer; it builds rich renderables, and prints nothing."""

from __future__ import annotations

from typing import Final

from rich.markup import escape
from rich.table import Table

from ring.result import Journey, Result, TopicResult

_EDGE_SWITCHES: Final = 2
_TEXTS: Final = ("topic", "type", "identical", "hops")
_WIDE: Final = ("bytes", "delivered", "duplicated", "p99 ms", "max ms", "silent ms", "parts")
_COLUMNS: Final = (
    *("topic", "type", "messages", "bytes", "delivered", "lost", "duplicated", "identical"),
    *("median ms", "p99 ms", "max ms", "silent ms", "parts", "hops"),
)


def table(result: Result, *, is_wide: bool = False) -> Table:
    """Return one row per topic: the columns that fit 100 characters, or with ``is_wide`` all."""
    of = result.settings
    title = f"{of['encoding']}, {of['data_plane']}, MTU {of['mtu']}"
    if "live" in of:
        title = f"live {of['live']}, {title}"
    for what in ("cuts", "roams", "kills"):
        faults = of.get(what)
        if isinstance(faults, list) and faults:
            title += f", {what.removesuffix('s')} " + ", ".join(f"{fault} s" for fault in faults)
    drawn = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    columns = [each for each in _COLUMNS if is_wide or each not in _WIDE]
    for heading in columns:
        if heading in _TEXTS:
            drawn.add_column(heading, overflow="fold")
        else:
            drawn.add_column(heading, justify="right", no_wrap=True)
    for row in result.topics:
        cells = dict(zip(_COLUMNS, _cells(row), strict=True))
        drawn.add_row(*(cells[each] for each in columns), style="red" if row.faults else None)
    return drawn


def summary(result: Result) -> str:
    """Return the last line, with markup."""
    if result.passed:
        topics = [row for row in result.topics if not row.is_service]
        calls = sum(row.comparison.messages for row in result.topics if row.is_service)
        count = sum(row.comparison.messages for row in topics)
        what = f"{count} messages on {len(topics)} topics, all identical"
        what += f"; {calls} calls, all answered" if calls else ""
        note = f" [yellow]Not all could be read: {escape(result.unread)}[/yellow]" if result.unread else ""
        return f"[bold green]passed[/bold green]: {what}.{note}"
    return f"[bold red]failed[/bold red]: {escape('; '.join(result.faults))}"


def hops_in_words(journey: Journey) -> str:
    """Return the switches that messages passed, such as ``5 (3 between)``: the usual number first, then others."""
    if not journey.hops:
        return "-"
    others = "".join(f", also {hops}" for hops in journey.hops_seen if hops != journey.hops)
    return f"{journey.hops} ({max(journey.hops - _EDGE_SWITCHES, 0)} between){others}"


def _cells(row: TopicResult) -> list[str]:
    of, way = row.comparison, row.journey
    return [
        escape(of.topic),
        escape(of.type_name),
        str(of.messages),
        f"{of.bytes:,}",
        str(of.delivered),
        str(of.lost),
        str(row.duplicated),
        "yes" if of.identical else "no",
        *map(_ms, (*way.latency_ms.values(), way.silent_ms)),
        str(way.parts or "-"),
        hops_in_words(way),
    ]


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
