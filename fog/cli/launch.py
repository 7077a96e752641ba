"""``fog launch``: start of a launch file's cluster, then of the robot's nodes when it serves."""

from __future__ import annotations

import logging
import signal
import time
from contextlib import closing
from dataclasses import replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from fog.cli.down import clear, end_cluster
from fog.cli.market import choices, in_regions, market, reached, refusal
from fog.cli.options import AsJson, SiteFile, State, opened, peeked
from fog.cli.robot_nodes import INTERRUPTED, Started, resolved, run
from fog.cli.views import print_event
from fog.cluster import ClusterPlan
from fog.launch.load import Loaded
from fog.site import Site, save_topology, with_gateway
from fog.supervisor.background import LOG, ensure
from fog.supervisor.infrastructure import command_of, is_up, open_provider, set_up
from fog.supervisor.journal import Journal
from gdp.cli.console import Columns, console
from gdp.errors import LocalError
from gdp.intervals import LOOK_S
from gdp.stores.keyring import load_salt
from gdp.terminal import echo

log = logging.getLogger(__name__)

WAIT_S: Final = 600.0  # for the replicas, unless another time is given


class GatewayKind(Enum):
    """Kind of gateway of a site without ``fog.yaml``."""

    DEDICATED = "dedicated"
    REPLICA = "replica"


File = Annotated[Path, typer.Argument(metavar="FILE", help="a launch file (.py), or a plan (.json)")]
Words = Annotated[list[str] | None, typer.Argument(metavar="[NAME:=VALUE]...")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="show machines and price, start nothing")]
Detach = Annotated[bool, typer.Option("--detach", help="end when the replicas serve; start no node of the robot")]
Keep = Annotated[bool, typer.Option("--keep", help="leave the cluster when the robot's nodes end")]
Gateway = Annotated[
    GatewayKind | None, typer.Option("--gateway", help="without fog.yaml: a switch of its own, or one of the machines")
]
Regions = Annotated[
    list[str] | None, typer.Option("--region", metavar="REGION", help="where machines are made, in order; repeatable")
]
# what else ends the cluster, such as another launch
EndsWith = Annotated[str, typer.Option("--ends-with", hidden=True)]
Wait = Annotated[float, typer.Option("--wait", metavar="S", min=0.0, help="how long the replicas may take")]


def launch(
    file: File,
    arguments: Words = None,
    site: SiteFile = None,
    state: State = None,
    dry_run: DryRun = False,
    detach: Detach = False,
    keep: Keep = False,
    wait: Wait = WAIT_S,
    gateway: Gateway = None,
    region: Regions = None,
    ends_with: EndsWith = "",
    columns: Columns = None,
    as_json: AsJson = False,
) -> None:
    """Start a launch file's cluster; when its replicas serve, run the robot's nodes until they end or Ctrl-C.

    With the robot's nodes the cluster ends, unless it is kept. A cluster of that name that is up takes the new plan.
    Machines are made in the regions of --region, in turn; without it where latency and price are best.
    What robot's nodes with output="log" print goes to a file in the state folder, which is printed.

    \b
    Examples:
      fog launch demo.launch.py --dry-run
      fog launch demo.launch.py
      fog launch demo.launch.py rate:=10 --detach
    """
    del columns  # the option's callback sets it
    from fog.cli.launch_view import BY_HAND, Priced, loaded_from, show_plan  # half a second to import

    def priced(here: Site) -> Priced:
        loaded = loaded_from(file, arguments or [], dry_run=dry_run)
        said = loaded.plan
        plan = replace(
            said,
            idle_s=here.config.idle_s if said.idle_s is None else said.idle_s,
            budget_usd=here.config.budget_usd if said.budget_usd is None else said.budget_usd,
            machines=in_regions(said.machines, region or []),
        )
        with closing(open_provider(here, [each.region for each in plan.machines if each.region])) as provider:
            found = market(provider, plan.machines, here.latencies)
            if None in (chosen := choices(found, plan.machines)):
                raise LocalError(refusal(provider, plan.machines, chosen))
            plan, target = reached(plan, found)
            topology = here.topology if here.config.provider == "local" else None
            chosen = choices(found, plan.machines)
            whole = Priced(replace(loaded, plan=plan), chosen, found.latencies, target, topology)
        ends = ends_with
        if not (detach or keep or loaded.keep) and loaded.robot_nodes:
            ends = "the robot's nodes"
        show_plan(whole, f"with {ends}, or {BY_HAND}" if ends else BY_HAND, as_json=as_json)
        return whole

    def check_programs(here: Site, loaded: Loaded) -> list[Started]:
        """Return the commands of the robot's nodes. Raises ``LocalError``: a program of the file does not exist."""
        for node in loaded.plan.nodes:
            command_of(here, node)
        return [] if detach else [resolved(each) for each in loaded.robot_nodes]

    if dry_run:
        with peeked(site, state) as known:
            here = _with(known, gateway)
            check_programs(here, priced(here).loaded)
        return
    with opened(site, state) as (known, journal):
        here = _with(known, gateway)
        loaded = priced(here).loaded
        plan = loaded.plan
        robot = check_programs(here, loaded)
        last = journal.last_event()
        for each in (signal.SIGINT, signal.SIGTERM):  # a shell lets programs in its background ignore the first
            signal.signal(each, signal.default_int_handler)
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
            code = run(robot, here.state / "nodes", partial(_check_wanted, journal, plan.name))
        finally:
            if not (keep or loaded.keep):
                end_cluster(here, journal, plan.name, "its launch has ended", as_json=as_json)
                clear(here, journal)
        raise typer.Exit(code)


def _with(site: Site, gateway: GatewayKind | None) -> Site:
    return site if gateway is None else with_gateway(site, is_replica=gateway is GatewayKind.REPLICA)


def _check_wanted(journal: Journal, name: str) -> None:
    """Raise ``LocalError`` once a cluster is given back, such as by another shell."""
    if not (now := journal.cluster(name)).is_up:
        raise LocalError(f"the cluster {name} was given back: {now.why}")


def begin(site: Site, journal: Journal, plan: ClusterPlan) -> None:
    """Store a cluster's plan in the journal, and ensure that a supervisor runs."""
    if site.robot is not None and not is_up(site):
        echo("making keys, and starting the network and the robot's switch, RIB and proxy", err=True)
    set_up(site)
    save_topology(site)
    journal.put_cluster(plan.salted(load_salt(site.authority.owner)), time.time())
    ensure(site)


def follow(site: Site, journal: Journal, plan: ClusterPlan, after: int, patience_s: float, *, as_json: bool) -> None:
    """Show events until all replicas serve; without a watch, until all machines are up."""
    out = console(stderr=as_json)
    end_s = time.monotonic() + patience_s
    wanted = len(plan.machines)
    trouble = ""
    is_watched = site.watch is not None
    serve = "replicas serve" if is_watched else "machines up (not watched)"

    def news() -> tuple[int, str]:
        last, reported = after, trouble
        for entry in journal.events(plan.name, after=after):
            print_event(entry, out, as_json=as_json)
            last = entry.id
            reported = entry.detail if entry.what in ("trouble", "refused", "failed") else reported
        return last, reported

    with out.status("") as spinner:
        while True:
            serving = sum(each.is_serving for each in journal.machines(plan.name, gone=False))
            spinner.update(f"{serving} of {wanted} {serve}")
            after, trouble = news()
            if serving >= wanted:
                break
            _check_wanted(journal, plan.name)
            if time.monotonic() >= end_s:
                why = f"; last trouble: {trouble}" if trouble else ""
                raise LocalError(
                    f"{serving} of {wanted} {serve} after {patience_s:g} s{why}; it goes on: fog status;"
                    f" the supervisor's words are in {site.state / LOG}"
                )
            ensure(site)
            time.sleep(LOOK_S)
    if not as_json:
        out.print(f"{wanted} {serve}", style="green" if is_watched else "yellow")
