"""Infrastructure of a site's clusters: the provider, and on this host the network and the robot's side.

I/O. It outlives the command that created it. Records in the state folder describe it, and ``tear_down`` removes it.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fog.bootstrap.bundles import gateway_boot
from fog.cluster import CloudNode
from fog.host.status import STATUS_FILE, Status
from fog.launch.resolve import command_line, deferred
from fog.machine import MachineState
from fog.providers.local.netlinks import delete
from fog.providers.local.spawn import spawn_detached
from fog.providers.provider import AccountProvider, Provider
from fog.site import SCRATCH, Site
from gdp.errors import LocalError
from gdp.extras import Seam
from gdp.host.run_registry import RunRegistry
from gdp.intervals import LOOK_S, MINUTE_S

if TYPE_CHECKING:
    from fog.providers.local.provider import LocalProvider

log = logging.getLogger(__name__)

_OWN_SPACE: Final = Path("/proc/self/ns/net")
_GATEWAY_DAYS: Final = 3_650.0
_PROVIDERS: Final[Seam[Callable[[Site], Provider]]] = Seam("fog.provider")


def open_provider(site: Site, regions: Sequence[str] = ()) -> Provider:
    """Return the site's provider; this creates no resources.

    Args:
        regions: regions in plans, which ``local`` simulates.

    Raises:
        LocalError: a requirement is not installed, or its settings are wrong.
    """
    if site.config.provider == "local":
        return local_provider(site, regions)
    return _PROVIDERS.get(site.config.provider, f"provider {site.config.provider}")(site)


def local_provider(site: Site, regions: Sequence[str] = ()) -> LocalProvider:
    """Return the provider ``local`` of a site. Raises ``LocalError``: its folder belongs to another user."""
    from fog.providers.local.provider import LocalProvider

    boot = partial(gateway_boot, site.authority, days=_GATEWAY_DAYS)
    return LocalProvider(site.state / "local", boot, site.topology, uplink=site.uplink, regions=regions)


def command_of(site: Site, node: CloudNode) -> Sequence[str]:
    """Return the command line of a node on a machine of this site.

    Raises:
        LocalError: machines share this host, and this host has no such node.
    """
    return command_line(node, os.environ) if site.config.provider == "local" else deferred(node)


def set_up(site: Site) -> None:
    """Set up the network between machines and robot; existing parts are unchanged.

    Raises:
        LocalError: the kernel refuses, or the robot's side does not come up; the text names its logs.
    """
    with site.locked("ground"):
        if site.config.provider == "local":
            local_provider(site).open_network()
        if site.robot is not None and not is_up(site):
            _start_robot(site, site.robot)


def is_up(site: Site) -> bool:
    """Return whether the robot's side runs."""
    return any(record.kept and not record.dead for record in _robot_runs(site).all())


def tear_down(site: Site) -> None:
    """Remove what ``set_up`` created, and leftovers of machines. No effect if there are none."""
    with site.locked("ground"):
        _robot_runs(site).take_down()
        if site.devices is not None:
            for name in (site.devices.proxy, site.devices.rib, site.devices.watch):
                delete(None, f"{name}-s")  # left over by a killed switch
        if site.config.provider == "local":
            provider = local_provider(site)
            provider.close_network()
            provider.sweep()
        else:
            with closing(open_provider(site)) as elsewhere:
                if isinstance(elsewhere, AccountProvider):
                    elsewhere.clear_account()
        for left in (site.state / SCRATCH).iterdir():  # keys of a machine whose creation was interrupted
            shutil.rmtree(left, ignore_errors=True)


def _robot_runs(site: Site) -> RunRegistry:
    return RunRegistry(site.state / "robot-runs")


def _start_robot(site: Site, home: Path) -> None:
    runs = _robot_runs(site)
    runs.sweep()
    (home / STATUS_FILE).unlink(missing_ok=True)
    (home / "logs").mkdir(mode=0o700, exist_ok=True)
    run = runs.start()
    argv = ["fog.host.cli", "--home", str(home), "--await-go"]
    try:
        spawn_detached(run, _OWN_SPACE, argv, home / "logs" / "machine.log", lambda _: None)
        _await_up(home)
    except BaseException:
        run.end()
        raise
    log.info("robot's side up home=%s", home)


def _await_up(home: Path) -> None:
    """Wait until all programs are up, by polling: status files have no change notification."""
    end_s = time.monotonic() + MINUTE_S
    while (status := Status.read(home)) is None or status.state is not MachineState.RUNNING:
        restarts = sum(each.restarts for each in status.programs.values()) if status is not None else 0
        if time.monotonic() > end_s or restarts > 2 or (status is not None and status.state is MachineState.GONE):
            raise LocalError(f"the robot's side does not come up; its programs' words are in {home / 'logs'}")
        time.sleep(LOOK_S)
