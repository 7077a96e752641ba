"""``fog down``: release of machines, and then of the infrastructure under them; works after any crash."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Annotated, Final

import typer

from fog.cli.options import AsJson, ClusterName, SiteFile, State, opened
from fog.cli.views import event_line, print_json
from fog.machine import MachineState
from fog.site import Site
from fog.supervisor.background import ensure, is_running, pid_of
from fog.supervisor.infrastructure import local_provider, open_provider, tear_down
from fog.supervisor.journal import Journal
from gdp.cli.console import console
from gdp.errors import LocalError, StoreError
from gdp.intervals import LOOK_S, STOP_S
from gdp.terminal import echo

_PATIENCE_S: Final = 20.0  # time for the supervisor; afterwards this process releases the machines
_TRIES: Final = 5

IfUp = Annotated[bool, typer.Option("--if-up", hidden=True)]  # for a launch that may not have started
All = Annotated[bool, typer.Option("--all", help="every cluster, and all that they stand on")]


def down(
    cluster: ClusterName = None,
    all_: All = False,
    if_up: IfUp = False,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """Give all machines of a cluster back; of the only one, if no name is given.

    It works after any crash: machines are found at their provider, also those that no journal knows.

    \b
    Examples:
      fog down
      fog down planner
      fog down --all
    """
    with opened(site, state, supervised=False) as (here, journal):
        known = {each.plan.name: each for each in journal.clusters()}
        if cluster is not None and cluster not in known and not if_up and not _has_machines(here, cluster):
            up = ", ".join(name for name in sorted(known) if known[name].is_up) or "none"
            raise LocalError(f"no cluster is called {cluster}; up: {up}")
        names = [cluster] if cluster is not None else sorted({*known, *(_standing(here) if all_ else ())})
        if cluster is None and not all_:
            names = [name for name in names if known[name].is_up] or names[:1]
            if len(names) > 1:
                raise LocalError(f"which cluster? There are {', '.join(names)}; --all: every one")
        ended = [end_cluster(here, journal, name, "fog down", as_json=as_json) for name in names]
        clear(here, journal, whatever=all_)
        if as_json:
            print_json({"ended": names, "machines": sum(ended)})
        elif not names:
            echo("nothing is up")


def clear(site: Site, journal: Journal, *, whatever: bool = False) -> None:
    """Remove the infrastructure of clusters if no cluster is up, or in any case with ``whatever``."""
    if whatever or not any(each.is_up for each in journal.clusters()):
        _leave(site)
        tear_down(site)


def end_cluster(site: Site, journal: Journal, name: str, why: str, *, as_json: bool) -> int:
    """Release all machines of a cluster, wait until they are gone, and print their number."""
    out = console(stderr=as_json)
    last = journal.last_event()
    journal.unwant(name, why, time.time())
    is_known = any(each.plan.name == name for each in journal.clusters())
    count = len(journal.machines(name, gone=False))
    with out.status(f"{name}: machines are given back"):
        if is_known and count:
            ensure(site)
        end_s = time.monotonic() + _PATIENCE_S
        while is_known and journal.machines(name, gone=False) and time.monotonic() < end_s:
            ensure(site)
            time.sleep(LOOK_S)
        rest = _release(site, name)
        now_s = time.time()
        left = journal.machines(name, gone=False)
        _remove_members(site, name, [each.name for each in left], now_s)
        for record in left:
            from fog.supervisor.core.record import Outcome

            journal.put(record.ended(record.ending or Outcome.RELEASED, why, now_s), now_s, "released", why)
    for entry in journal.events(name, after=last):
        if not as_json:
            out.print(event_line(entry))
    return max(count, rest)


def _remove_members(site: Site, cluster: str, machines: Sequence[str], now_s: float) -> None:
    """Remove machines from the domain that no supervisor has removed."""
    if not machines:
        return
    from fog.bootstrap.bundles import machine_label
    from fog.bootstrap.domain_members import DomainMembers
    from fog.supervisor.machine_credentials import remove_member

    with closing(DomainMembers(site.domain_files)) as members:
        for each in machines:
            remove_member(site, members, machine_label(cluster, each), now_s)


def _release(site: Site, name: str) -> int:
    """Terminate the machines that the provider still has of a cluster; return their number."""
    with closing(open_provider(site)) as provider:
        found: set[str] = set()
        for _ in range(_TRIES):
            machines = provider.describe(name)
            living = [each.id for each in machines if each.state is not MachineState.GONE]
            provider.terminate([each.id for each in machines])
            found.update(living)
            if not living:
                return len(found)
            time.sleep(provider.poll_s)
    raise StoreError(f"{name}: the provider still has machines; once more: fog down {name}")


def _standing(site: Site) -> set[str]:
    """Return the clusters that have machines, by the provider's own records."""
    if site.config.provider != "local":
        return set()
    from fog.providers.local.machine_handle import list_machines

    return {each.file.spec.cluster for each in list_machines(local_provider(site).runs)}


def _has_machines(site: Site, cluster: str) -> bool:
    """Return whether the provider has machines of a cluster that the journal does not contain."""
    with closing(open_provider(site)) as provider:
        return any(each.state is not MachineState.GONE for each in provider.describe(cluster))


def _leave(site: Site) -> None:
    """Stop the supervisor; it has no clusters."""
    pid = pid_of(site)
    if pid is None:
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.kill(pid, number)
        end_s = time.monotonic() + STOP_S
        while is_running(site) and time.monotonic() < end_s:
            time.sleep(LOOK_S)
