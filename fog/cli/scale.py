"""``fog scale``, ``push``, ``ssh`` and ``supervise``: verbs for existing clusters and machines."""

from __future__ import annotations

import os
import time
from contextlib import closing
from dataclasses import replace
from typing import Annotated

import typer

from fog.cli.launch import WAIT_S, follow
from fog.cli.market import choices, market, refusal
from fog.cli.options import AsJson, ClusterOption, SiteFile, State, machine_of, opened, the_cluster
from fog.cli.views import print_json
from fog.cluster import ClusterPlan
from fog.supervisor.background import ensure
from fog.supervisor.core.record import stage
from fog.supervisor.infrastructure import open_provider, set_up
from gdp.cli.node import Logs, running
from gdp.errors import LocalError
from gdp.terminal import echo

scale = typer.Typer(no_args_is_help=True, help="Add or take away replicas while all runs.")

Count = Annotated[int, typer.Argument(metavar="[N]", min=1, help="how many")]
Detach = Annotated[bool, typer.Option("--detach", help="do not wait")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="show what it would cost, change nothing")]
Machine = Annotated[str, typer.Argument(metavar="MACHINE", help="such as m3; see fog status")]
Lock = Annotated[int | None, typer.Option("--lock", hidden=True)]
Stay = Annotated[bool, typer.Option("--stay", help="go on also while nothing is wanted; for systemd")]


@scale.command("up")
def up(
    count: Count = 1,
    cluster: ClusterOption = None,
    site: SiteFile = None,
    state: State = None,
    dry_run: DryRun = False,
    detach: Detach = False,
    as_json: AsJson = False,
) -> None:
    """Add replicas like the last one of the plan, in regions of their own where that can be had.

    \b
    Examples:
      fog scale up
      fog scale up 2 --cluster planner --dry-run
    """
    with opened(site, state) as (here, journal):
        plan = the_cluster(journal, cluster).plan
        _refuse_autoscaled(plan)
        more = [replace(plan.machines[-1], region="")] * count
        with closing(open_provider(here)) as provider:
            offers = choices(market(provider, more, here.latencies), more)
            if None in offers:
                raise LocalError(refusal(provider, more, offers))
        usd = sum(each.usd_per_hour for each in offers if each is not None)
        if dry_run:
            _say({"cluster": plan.name, "adds": count, "usd_per_hour": round(usd, 6)}, as_json=as_json)
            return
        last = journal.last_event()
        wider = replace(plan, machines=(*plan.machines, *more))
        set_up(here)
        journal.put_cluster(wider, time.time(), why=f"{len(plan.machines)} -> {len(wider.machines)} machines")
        ensure(here)
        if not detach:
            follow(here, journal, wider, last, WAIT_S, as_json=as_json)


@scale.command("down")
def down(
    count: Count = 1,
    cluster: ClusterOption = None,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """Take replicas away: first those that do not serve, then the youngest.

    What is under way on them is answered.

    \b
    Example:
      fog scale down 1 --cluster planner
    """
    with opened(site, state) as (here, journal):
        plan = the_cluster(journal, cluster).plan
        _refuse_autoscaled(plan)
        left = len(plan.machines) - count
        if left < 1:
            raise LocalError(f"{plan.name} has {len(plan.machines)} machines; to end it: fog down {plan.name}")
        smaller = replace(plan, machines=plan.machines[:left])
        journal.put_cluster(smaller, time.time(), why=f"{len(plan.machines)} -> {left} machines")
        ensure(here)
        _say({"cluster": plan.name, "machines": left}, as_json=as_json)


def push(cluster: ClusterOption = None, site: SiteFile = None, state: State = None, as_json: AsJson = False) -> None:
    """Bring the present wheels and workspace to a cluster: each machine is replaced, and serves until then.

    New machines fetch what the section software of fog.yaml names. What is under way is answered.

    \b
    Examples:
      fog push
      fog push --cluster planner --json
    """
    with opened(site, state) as (here, journal):
        plan = the_cluster(journal, cluster).plan
        if here.config.provider != "local" and here.config.software.is_empty:
            raise LocalError(
                f"{plan.name}: fog.yaml has no software to push; name software.wheels or software.workspace"
            )
        now_s = time.time()
        journal.put_cluster(replace(plan, pushed_unix_s=now_s), now_s, why="software pushed")
        ensure(here)
        there = sum(not each.is_gone for each in journal.machines(plan.name))
        _say({"cluster": plan.name, "replaces": there}, as_json=as_json)


def ssh(machine: Machine, cluster: ClusterOption = None, site: SiteFile = None, state: State = None) -> None:
    """Open a shell on a machine.

    \b
    Example:
      fog ssh m1
    """
    with opened(site, state) as (here, journal):
        record = machine_of(journal, cluster, machine)
        if record.is_gone:
            raise LocalError(f"{record.name} is gone: {stage(record)}, {record.reason}")
        with closing(open_provider(here)) as provider:
            words = provider.shell(record.id)
        os.execvp(words[0], words)


def supervise(
    site: SiteFile = None,
    state: State = None,
    stay: Stay = False,
    lock: Lock = None,
    *,
    logs: Logs,
) -> None:
    """Keep clusters as they are wanted. Other verbs start it by themselves, in the background.

    \b
    Example:
      fog supervise --stay
    """
    from fog.supervisor.process import supervise as be_supervisor

    with running(logs), opened(site, state, supervised=False) as (here, _):
        be_supervisor(here, stays=stay, lock=lock)


def _refuse_autoscaled(plan: ClusterPlan) -> None:
    if plan.scale is not None:
        least, most = plan.scale.min_machines, plan.scale.max_machines
        raise LocalError(f"{plan.name} scales itself, {least} to {most} machines; launch it again with another scale")


def _say(fields: dict[str, object], *, as_json: bool) -> None:
    if as_json:
        print_json(fields)
    else:
        echo(", ".join(f"{key.replace('_', ' ')}: {value}" for key, value in fields.items()))
