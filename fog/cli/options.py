"""Options and site access shared by the verbs of ``fog``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from fog.site import Site, open_site, peek_site
from fog.supervisor.background import ensure
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Cluster, Journal
from gdp.cli.node import failing_clearly
from gdp.errors import LocalError

SiteFile = Annotated[
    Path | None,
    typer.Option("--site", metavar="FILE", help="fog.yaml; without it the one in this folder, else a site of its own"),
]
State = Annotated[
    Path | None,
    typer.Option("--state", metavar="DIR", help="where clusters are remembered; default: $FOG_STATE, ~/.local/state"),
]
ClusterName = Annotated[str | None, typer.Argument(metavar="[CLUSTER]", help="only this one")]
ClusterOption = Annotated[
    str | None, typer.Option("--cluster", metavar="NAME", help="which cluster, where there are several")
]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]


@contextmanager
def opened(file: Path | None, state: Path | None, *, supervised: bool = True) -> Iterator[tuple[Site, Journal]]:
    """Yield the site and its journal; errors end the command with one line and exit status 2.

    Args:
        supervised: start a supervisor if a cluster is wanted and no supervisor runs.
    """
    with failing_clearly():
        site = open_site(file, state)
        with closing(Journal(site.journal)) as journal:
            if supervised and any(each.is_up for each in journal.clusters()):
                ensure(site)
            yield site, journal


@contextmanager
def peeked(file: Path | None, state: Path | None) -> Iterator[Site]:
    """Yield the site for a verb that changes nothing; errors as with ``opened``."""
    with failing_clearly(), peek_site(file, state) as site:
        yield site


def the_cluster(journal: Journal, name: str | None) -> Cluster:
    """Return the named cluster, or the only one that is up."""
    if name is not None:
        return journal.cluster(name)
    up = [each for each in journal.clusters() if each.is_up]
    if len(up) == 1:
        return up[0]
    if not up:
        raise LocalError("no cluster is up; start one with: fog launch FILE")
    raise LocalError(f"which cluster? There are {', '.join(each.plan.name for each in up)}")


def machine_of(journal: Journal, cluster: str | None, name: str) -> Record:
    """Return the record of a machine that has an id."""
    plan = the_cluster(journal, cluster).plan
    records = journal.machines(plan.name)
    found = next((each for each in records if each.name == name), None)
    if found is None or not found.id:
        living = ", ".join(each.name for each in records if not each.is_gone) or "none"
        raise LocalError(f"{plan.name} has no machine {name}: there are {living}")
    return found
