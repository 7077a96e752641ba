"""``fog ls``, ``status`` and ``cost``: clusters, events and costs."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Final, NoReturn

import typer
from rich.console import Group
from rich.live import Live
from rich.table import Table

from fog.cli.options import AsJson, ClusterName, SiteFile, State, opened, the_cluster
from fog.cli.views import (
    cluster_fields,
    clusters_table,
    cost_fields,
    costs_table,
    event_line,
    events_table,
    machine_fields,
    machines_table,
    print_event,
    print_json,
    show,
)
from fog.site import Site
from fog.supervisor.background import pid_of
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Cluster, Journal
from gdp.cli.console import Columns, console
from gdp.intervals import WATCH_S
from gdp.terminal import echo

_EVENTS: Final = 20
_LATEST: Final = 6
_FLEETING: Final = {"age_s", "usd", "usd_ever"}

Everything = Annotated[bool, typer.Option("--all", "-a", help="those that are gone as well")]
Events = Annotated[bool, typer.Option("--events", help="what happened, the newest last")]
Follow = Annotated[bool, typer.Option("--follow", "-f", help="go on as things happen, until Ctrl-C")]
Last = Annotated[int | None, typer.Option("--last", "-n", min=1, help="only so many events")]


def ls(
    all_: Everything = False,
    columns: Columns = None,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """List clusters.

    \b
    Example:
      fog ls
    """
    del columns  # the option's callback sets it
    with opened(site, state) as (_, journal):
        rows = [_fields(journal, each) for each in journal.clusters() if all_ or each.is_up or _left(journal, each)]
        if as_json:
            print_json(rows)
        elif rows:
            show(clusters_table(rows))
        else:
            echo("no cluster is up")


def status(
    cluster: ClusterName = None,
    all_: Everything = False,
    events: Events = False,
    follow: Follow = False,
    last: Last = None,
    columns: Columns = None,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """Show a cluster's machines, or what happened to them.

    \b
    Examples:
      fog status
      fog status planner --events --last 50
      fog status --follow
    """
    del columns  # the option's callback sets it
    with opened(site, state) as (here, journal):
        found = the_cluster(journal, cluster)
        name = found.plan.name
        try:
            if events:
                _events(journal, name, last or _EVENTS, follow=follow, as_json=as_json)
            elif as_json:
                _as_json(lambda: _status(here, journal, journal.cluster(name), gone=all_), follow=follow)
            elif follow and not console().is_terminal:
                show(_page(here, journal, found, gone=all_))
                _follow(journal, name, journal.last_event(), as_json=False)
            elif follow:
                with Live(console=console(), auto_refresh=False) as live:
                    while True:
                        live.update(_page(here, journal, journal.cluster(name), gone=all_), refresh=True)
                        time.sleep(WATCH_S)
            else:
                show(_page(here, journal, found, gone=all_))
        except KeyboardInterrupt:
            raise typer.Exit(0) from None


def cost(
    cluster: ClusterName = None,
    columns: Columns = None,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """Show what clusters have cost and cost now, by the prices at which their machines were asked for.

    \b
    Example:
      fog cost
    """
    del columns  # the option's callback sets it
    with opened(site, state) as (_, journal):
        clusters = journal.clusters() if cluster is None else [journal.cluster(cluster)]
        rows = [cost_fields(each, journal.machines(each.plan.name), time.time()) for each in clusters]
        if as_json:
            print_json(rows)
        elif rows:
            show(costs_table(rows))
        else:
            echo("there was no cluster yet")


def _left(journal: Journal, cluster: Cluster) -> bool:
    return bool(journal.machines(cluster.plan.name, gone=False))


def _fields(journal: Journal, cluster: Cluster) -> dict[str, object]:
    return cluster_fields(cluster, journal.machines(cluster.plan.name), time.time())


def _status(site: Site, journal: Journal, cluster: Cluster, *, gone: bool) -> dict[str, object]:
    now_s, records = time.time(), journal.machines(cluster.plan.name)
    return {
        **cluster_fields(cluster, records, now_s),
        "supervisor_pid": pid_of(site),
        "watched": site.watch is not None,
        "members": _members(site, records, now_s, gone=gone),
        "cost": cost_fields(cluster, records, now_s),
    }


def _page(site: Site, journal: Journal, cluster: Cluster, *, gone: bool) -> Group:
    now_s, records = time.time(), journal.machines(cluster.plan.name)
    rows = _members(site, records, now_s, gone=gone)
    pid = pid_of(site)
    supervisor = f"pid {pid}" if pid is not None else "begins" if cluster.is_up else "none lives, none is needed"
    parts: list[Table | str | Group] = [
        clusters_table([cluster_fields(cluster, records, now_s)]),
        "",
        machines_table(rows, now_s) if rows else "no machines",
        "",
        Group(*map(event_line, journal.events(cluster.plan.name, last=_LATEST))),
        f"[dim]supervisor: {supervisor}[/]",
    ]
    return Group(*parts)


def _events(journal: Journal, name: str, last: int, *, follow: bool, as_json: bool) -> None:
    entries = journal.events(name, last=last)
    if as_json:
        for entry in entries:
            print_json(entry)
    else:
        show(events_table(entries))
    if follow:
        _follow(journal, name, max((each.id for each in entries), default=0), as_json=as_json)


def _follow(journal: Journal, name: str, after: int, *, as_json: bool) -> NoReturn:
    """Print one line per event until Ctrl-C."""
    out = console()
    while True:
        for entry in journal.events(name, after=after):
            after = entry.id
            print_event(entry, out, as_json=as_json)
        sys.stdout.flush()
        time.sleep(WATCH_S)


def _as_json(look: Callable[[], dict[str, object]], *, follow: bool) -> None:
    """Print the state as a line of JSON; with ``follow`` again after each change except of time and cost."""
    reported: object = None
    while True:
        now = look()
        if (state := _lasting(now)) != reported:
            reported = state
            print_json(now)
            sys.stdout.flush()
        if not follow:
            return
        time.sleep(WATCH_S)


def _lasting(value: object) -> object:
    if isinstance(value, dict):
        return {key: _lasting(each) for key, each in value.items() if key not in _FLEETING}
    return [_lasting(each) for each in value] if isinstance(value, list) else value


def _members(site: Site, records: Sequence[Record], now_s: float, *, gone: bool) -> list[dict[str, object]]:
    shown = [each for each in records if gone or not each.is_gone]
    latency_ms = site.latencies.ms((each.spec.offer.region for each in shown), now_s)
    return [machine_fields(each, now_s, latency_ms, is_watched=site.watch is not None) for each in shown]
