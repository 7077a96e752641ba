"""``fog launch``: a launch file's cluster, and the robot's nodes once it serves.

Place: command.
"""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Optional

import typer
from rich.console import Console

from fog.cli.ending import clear, end_cluster
from fog.cli.options import AsJson, SiteFile, State, opened
from fog.cli.robot_nodes import INTERRUPTED, resolved, run
from fog.cli.views import event_line, print_json
from fog.cluster import ClusterPlan, Wanted
from fog.offer import Offer
from fog.plan.choice import choose
from fog.providers.provider import Provider
from fog.site import Site
from fog.supervisor.background import LOG, ensure
from fog.supervisor.ground import command_of, open_provider, stand
from fog.supervisor.journal import Entry, Journal
from gdp.errors import LocalError

__all__ = ["begin", "choices", "follow", "launch"]

log = logging.getLogger(__name__)

_WAIT_S: Final = 600.0
_STEP_S: Final = 0.05

File = Annotated[Path, typer.Argument(metavar="FILE", help="a launch file (.py), or a plan (.json)")]
Words = Annotated[Optional[list[str]], typer.Argument(metavar="[NAME:=VALUE]...")]  # noqa: UP045
DryRun = Annotated[bool, typer.Option("--dry-run", help="show machines and price, start nothing")]
Detach = Annotated[bool, typer.Option("--detach", help="end when the replicas serve; start no node of the robot")]
Keep = Annotated[bool, typer.Option("--keep", help="leave the cluster when the robot's nodes end")]
EndsWith = Annotated[str, typer.Option("--ends-with", hidden=True)]  # what else, such as another launch, ends it
Wait = Annotated[float, typer.Option("--wait", metavar="S", min=0.0, help="how long the replicas may take")]


def launch(
    file: File,
    arguments: Words = None,
    site: SiteFile = None,
    state: State = None,
    dry_run: DryRun = False,
    detach: Detach = False,
    keep: Keep = False,
    wait: Wait = _WAIT_S,
    ends_with: EndsWith = "",
    as_json: AsJson = False,
) -> None:
    """Start a launch file's cluster; when its replicas serve, run the robot's nodes until they end or Ctrl-C.

    With the robot's nodes the cluster ends, unless it is kept. A cluster of that name that is up takes the new plan.
    What robot's nodes with output="log" print goes to a file in the state folder, which is told.

    \b
    Examples:
      fog launch demo.launch.py --dry-run
      fog launch demo.launch.py
      fog launch demo.launch.py rate:=10 --detach
    """
    from fog.cli.launch import BY_HAND, loaded_from, show_plan  # rules and their messages: half a second to import

    with opened(site, state) as (here, journal):
        loaded = loaded_from(file, arguments or [], dry_run=dry_run)
        plan = replace(
            loaded.plan,
            idle_s=here.idle_s if loaded.plan.idle_s is None else loaded.plan.idle_s,
            budget_usd=here.budget_usd if loaded.plan.budget_usd is None else loaded.plan.budget_usd,
        )
        with closing(open_provider(here, [each.region for each in plan.machines if each.region])) as provider:
            offers = choices(provider, plan.machines, here.latency_ms)
        if not (detach or keep or loaded.keep) and loaded.robot_nodes:
            ends_with = "the robot's nodes"
        ends = f"with {ends_with}, or {BY_HAND}" if ends_with else BY_HAND
        show_plan(replace(loaded, plan=plan), offers, ends, as_json=as_json)
        if dry_run:
            return
        for node in plan.nodes:
            command_of(here, node)  # complains before anything is started
        robot = [] if detach else [resolved(each) for each in loaded.robot_nodes]
        last = max((each.id for each in journal.events(last=1)), default=0)
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # it ends as with Ctrl-C
        try:
            begin(here, journal, plan)
            follow(here, journal, plan, last, wait, as_json=as_json)
        except KeyboardInterrupt:
            if not detach:
                end_cluster(here, journal, plan.name, "its launch was broken off", as_json=as_json)
                clear(here, journal)
            raise typer.Exit(INTERRUPTED) from None
        if detach or not loaded.robot_nodes:
            return
        try:
            code = run(robot, here.state / "nodes")
        finally:
            if not (keep or loaded.keep):
                end_cluster(here, journal, plan.name, "its launch has ended", as_json=as_json)
                clear(here, journal)
        raise typer.Exit(code)


def choices(provider: Provider, machines: Sequence[Wanted], latency_ms: Mapping[str, float]) -> list[Offer | None]:
    """Return for each machine what it would be now; None: nothing like it is to be had."""
    offers: dict[Offer, None] = {}
    for each in dict.fromkeys(machines):
        offers |= dict.fromkeys(provider.offers(each.hardware, spot=each.is_spot))
    found: list[Offer | None] = []
    for each in machines:
        used = [offer.region for offer in found if offer is not None]
        try:
            found.append(choose(list(offers), [each], latency_ms, used=used)[0].offer)
        except LocalError:
            found.append(None)
    return found


def begin(site: Site, journal: Journal, plan: ClusterPlan) -> None:
    """Write that a cluster is wanted, and see to it that somebody cares for it.

    Raises:
        LocalError: what it is to stand on cannot be made.
    """
    stand(site)
    journal.want(plan, time.time())
    ensure(site)


def follow(site: Site, journal: Journal, plan: ClusterPlan, after: int, patience_s: float, *, as_json: bool) -> None:
    """Show what happens until all replicas serve.

    Raises:
        LocalError: they do not in time, or the cluster is given up.
    """
    console = Console(stderr=as_json, highlight=False)
    end_s = time.monotonic() + patience_s
    wanted = len(plan.machines)
    trouble = ""

    def news() -> tuple[int, str]:
        last, told = after, trouble
        for entry in journal.events(plan.name, after=after):
            _tell(entry, console, as_json=as_json)
            last = entry.id
            told = entry.detail if entry.what in ("trouble", "refused", "failed") else told
        return last, told

    with console.status("") as spinner:
        while True:
            serving = sum(each.is_serving for each in journal.machines(plan.name, gone=False))
            spinner.update(f"{serving} of {wanted} replicas serve")
            after, trouble = news()
            if serving >= wanted:
                break
            if not (now := journal.cluster(plan.name)).is_up:
                raise LocalError(f"cluster {plan.name} is given up: {now.why}")
            if time.monotonic() >= end_s:
                why = f"; last trouble: {trouble}" if trouble else ""
                raise LocalError(
                    f"{serving} of {wanted} replicas serve after {patience_s:g} s{why}; it goes on: fog status;"
                    f" the supervisor's words are in {site.state / LOG}"
                )
            ensure(site)
            time.sleep(_STEP_S)
    if not as_json:
        console.print(f"[green]{wanted} replicas serve[/]")


def _tell(entry: Entry, console: Console, *, as_json: bool) -> None:
    if as_json:
        print_json(entry)
    else:
        console.print(event_line(entry))
