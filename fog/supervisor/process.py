"""Supervisor process of a site: its parts, signals and shutdown.

I/O. Separate from ``background``, because its imports take longer than most commands run.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from types import FrameType
from typing import Final

from fog.bootstrap.domain_members import DomainMembers
from fog.host.joining import JOIN_DEADLINE_S
from fog.site import Site, topology_now
from fog.software.server import SoftwareServer
from fog.supervisor.background import held
from fog.supervisor.core.reconcile import Timeouts
from fog.supervisor.infrastructure import command_of, open_provider, set_up
from fog.supervisor.journal import Journal
from fog.supervisor.snapshot import supervisor_snapshot
from fog.supervisor.supervisor import Supervisor
from fog.supervisor.watch import Watch
from fog.topology import Gateway
from gdp.enrolment.server import bind_unix, serve_domain_in_thread
from gdp.errors import LocalError, StoreError
from gdp.host.processes import Process
from gdp.host.service_notifier import service_notifier
from gdp.management.control_socket import CONTROL_SOCKET, ControlHandlers, serve_control_in_thread
from gdp.ports.tcp_server import listen_tcp

log = logging.getLogger(__name__)

_DONE_S: Final = 2.0  # it ends after this time without a wanted cluster


def supervise(site: Site, *, stays: bool = False, lock: int | None = None) -> None:
    """Run the supervisor until SIGTERM or, unless ``stays``, until no cluster is wanted.

    Args:
        lock: descriptor of the lock, if it is already held.

    Raises:
        LocalError: another supervisor runs, the provider is not available, or a port for machines is taken.
    """
    timeouts = Timeouts() if site.config.provider == "local" else Timeouts(boot_s=JOIN_DEADLINE_S)
    with (
        held(site, lock),
        closing(Journal(site.journal)) as journal,
        service_notifier() as notifier,
        _members(site) as members,
        _software(site, timeouts.boot_s) as software,
    ):
        _run(site, journal, members, timeouts, software, notifier.beat, stays=stays)


@contextmanager
def _members(site: Site) -> Iterator[DomainMembers]:
    """Yield the domain's members; the enrolment server runs while within, unless a border runs it."""
    files = site.domain_files
    with ExitStack() as stack:
        members = stack.enter_context(closing(DomainMembers(files)))
        if site.border is None:
            listening = bind_unix(site.enrolment_socket, socket.SOCK_STREAM)
            stack.enter_context(serve_domain_in_thread(files, listening))
        yield members


@contextmanager
def _software(site: Site, lifetime_s: float) -> Iterator[Callable[[], Mapping[str, bytes]]]:
    """Serve the software of rented machines; yield what returns the files by which a new machine fetches it."""
    if site.config.provider == "local" or site.config.software.is_empty:
        yield dict
        return
    host, port = site.software_listens
    try:
        listening = listen_tcp(host, port)
    except OSError as error:
        raise LocalError(f"software: listen on {host or '*'}:{port}: {error.strerror or error}") from error
    with ExitStack() as stack:
        stack.callback(listening.close)
        url = f"https://{site.config.software_address}"
        server = SoftwareServer(listening, site.state / "software", site.config.software, url, time.time)
        stack.callback(server.close)
        yield partial(server.bundle_file, lifetime_s)


def _run(
    site: Site,
    journal: Journal,
    members: DomainMembers,
    timeouts: Timeouts,
    software: Callable[[], Mapping[str, bytes]],
    beat: Callable[[], None],
    *,
    stays: bool,
) -> None:
    ended, drained = threading.Event(), threading.Event()
    watch = Watch(*site.watch) if site.watch is not None else None
    offered = _offered(site, journal)
    provider = open_provider(replace(site, topology=offered[1]), offered[0])
    supervisor = Supervisor(
        site=site,
        journal=journal,
        members=members,
        provider=provider,
        command=partial(command_of, site),
        watch=watch,
        patience=timeouts,
        software=software,
    )

    def drain() -> None:
        ended.set()
        supervisor.wake()

    handlers = ControlHandlers(
        reload=supervisor.wake,
        status=partial(_status, site, supervisor, time.monotonic()),
        snapshot=partial(_snapshot, site),
        drain=drain,
        is_drained=drained.is_set,
    )
    _call_on_signals(drain)
    log.info("supervisor begins site=%s provider=%s pid=%d", site.state, provider.name, os.getpid())
    done_at_s: float | None = None
    is_reconciled = False
    stack = ExitStack()
    try:
        stack.enter_context(serve_control_in_thread(site.state / CONTROL_SOCKET, handlers))
        if any(each.is_up for each in journal.clusters()):
            set_up(site)  # after a crash of this host the infrastructure is gone
        while not ended.is_set():
            try:
                if (now := _offered(site, journal)) != offered:
                    offered = now
                    supervisor.use(open_provider(replace(site, topology=offered[1]), offered[0]))
                supervisor.reconcile()
                if not is_reconciled:
                    supervisor.reconciled(_begun_unix_s())
                    is_reconciled = True
                is_done = supervisor.is_done and not stays
            except StoreError as error:
                log.error("look failed reason=%s", error)
                is_done = False
            if not is_done:
                done_at_s = None
            elif done_at_s is None:
                done_at_s = time.monotonic()
            elif time.monotonic() - done_at_s >= _DONE_S:
                break
            supervisor.wait(beat)
    finally:
        supervisor.close()
        drained.set()  # no action runs any more, and all results are in the journal
        stack.close()
        if watch is not None:
            watch.close()
        provider.close()
    log.info("supervisor ends")


def _call_on_signals(drain: Callable[[], None]) -> None:
    def handle(number: int, frame: FrameType | None) -> None:
        del number, frame
        drain()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, handle)


def _status(site: Site, supervisor: Supervisor, begun_s: float) -> dict[str, object]:
    """Return the supervisor's fields of ``gdp status``; called from the thread of the control socket."""
    with closing(Journal(site.journal)) as journal:
        clusters = [each.plan.name for each in journal.clusters() if each.is_up]
        machines = sum(len(journal.machines(each, gone=False)) for each in clusters)
    return {
        "role": "supervisor",
        "uptime_s": round(time.monotonic() - begun_s, 1),
        "clusters": clusters,
        "machines": machines,
        "actions": supervisor.running_actions,
    }


def _snapshot(site: Site) -> dict[str, object]:
    """Return the supervisor's fields of a live view; called from the thread of the control socket."""
    with closing(Journal(site.journal)) as journal:
        return supervisor_snapshot(journal)


def _offered(site: Site, journal: Journal) -> tuple[tuple[str, ...], Gateway]:
    """Return what the provider must offer: the regions in plans, and the gateways."""
    wanted = (each for cluster in journal.clusters() for each in cluster.plan.machines)
    return tuple(dict.fromkeys(each.region for each in wanted if each.region)), topology_now(site)


def _begun_unix_s() -> float:
    """Return when this process was started, before its imports."""
    started_s = Process.from_pid(os.getpid()).started / os.sysconf("SC_CLK_TCK")
    return time.time() - (time.clock_gettime(time.CLOCK_BOOTTIME) - started_s)
