"""Environment of the demonstration: a ring of five switches, the robot at nuc1, a site of ``fog`` behind nuc5.

I/O; creates namespaces, keys and files of one run.
::

    caller -- proxy -- nuc1 -- nuc2 -- nuc3 (RIB) -- nuc4 -- nuc5 -- gateway --+-- m1
                         |____________ cost 100 ______________|                +-- m2 ...

Resources of ``fog`` outlive this process, like machines of a cloud. A run therefore ends with ``fog down``, and records
lead to the leftovers of a killed run. The records are in a separate folder, which no other program sweeps.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.run_registry import Run, RunRegistry, outer_uid
from lab.children import Child, Children
from lab.credentials import OverlayCredentials
from lab.namespaces import Namespaces
from lab.topology import Attachment, DomainPlan, Topology, ring5

ROBOT: Final = "nuc1"
FAR: Final = "nuc5"
_RIB_AT: Final = "nuc3"
_WATCH: Final = "watch"
_DOMAIN: Final = 30
_DOWN_S: Final = 60.0
STATE: Final = "state"
SITE: Final = "fog.yaml"
ENVIRONMENT: Final = {
    "ROS_DOMAIN_ID": str(_DOMAIN),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",  # LOCALHOST enables shared memory, which crosses namespaces
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}


class Environment:
    """Ring of one run and its site.

    ``run``: registry that takes down the ring; ``end_all_of`` first takes down the resources of ``fog``.
    """

    def __init__(self, run: Run) -> None:
        ring = ring5()
        attached = (
            Attachment(_RIB_AT, "rib", "rib"),
            Attachment(ROBOT, "proxy", "robot"),
            Attachment(FAR, "proxy", _WATCH),
        )
        self._topology = Topology(ring.links, (DomainPlan("ring", ring.nodes),), attached)
        self._run = run
        self._namespaces = Namespaces(self._topology, run)
        self._credentials = OverlayCredentials(self._topology, run.directory)
        self.children = Children(run, kept=False)
        self.state = run.directory / STATE
        self.site_file = run.directory / SITE

    async def stand_up(self) -> str:
        """Start switches, RIB and the robot's proxy; return the data plane of the switches."""
        uplink = f"fog{self._run.id}-up"
        proxy, far_switch = self._write_proxy(), self._write_far_switch(uplink)
        self._write_site(uplink, proxy, far_switch)
        switches = []
        for node in self._topology.nodes:
            config = far_switch if node == FAR else self._credentials.switch(node, "auto")
            switches.append(self._start(node, "switch", ["-m", "gdp.cli.switch", "--config", str(config), "--json"]))
        planes = {each.text("data_plane") for each in await self.children.ready(switches)}
        (at,) = self._topology.attached("rib")
        rib = ["-m", "gdp.cli.rib", "--config", str(self._credentials.rib(at)), "--json"]
        await self.children.ready([self._start(at.switch, "rib", rib)])
        await self.children.ready(
            [self._start(ROBOT, "proxy", ["-m", "proxy.cli.proxy", "--config", str(proxy), "--json"])]
        )
        return ", ".join(sorted(planes))

    async def fog(self, *words: str, patience_s: float) -> None:
        """Run a command of ``fog`` on the host of the far switch until it ends.

        Raises ``FailedError``: it failed; the text has its last output.
        """
        argv = fog_command(self._run, words)
        child = self._start(FAR, f"fog-{words[0]}", argv, heard=False)
        if await self.children.guarded(child.wait(patience_s)):
            raise child.failed("failed")

    def start_caller(self, rate_hz: float) -> Child:
        """Start the robot's node: it calls ``/echo`` at this rate until SIGINT."""
        options = ["-p", f"rate_hz:={rate_hz}", "-p", "report_s:=0.5"]
        return self._start(ROBOT, "caller", ["-m", "fog_demo.caller", "--ros-args", *options])

    def _start(self, node: str, role: str, arguments: list[str], *, heard: bool = True) -> Child:
        return self.children.start_in(self._namespaces, node, role, arguments, heard=heard, environment=ENVIRONMENT)

    def _write_proxy(self) -> Path:
        """Write the robot's configuration, without a rule: ``fog`` adds them."""
        (at,) = (each for each in self._topology.attached("proxy") if each.switch == ROBOT)
        return self._credentials.proxy(at, {}, ros={"endpoint": "ros2", "domain": _DOMAIN})

    def _write_far_switch(self, uplink: str) -> Path:
        """Write ``switch.yaml`` of the far switch, with an additional port and the folder of revocations."""
        revocations = self._run.directory / "revocations"
        revocations.mkdir(mode=0o700)
        ports = [*self._credentials.ports(FAR), {"iface": uplink, "optional": True}]
        return self._credentials.switch(FAR, "auto", ports=ports, revocations=str(revocations))

    def _write_site(self, uplink: str, proxy: Path, switch: Path) -> None:
        folder = self._run.directory
        content = {
            "domain": str(folder / "domains" / "ring"),
            "owner": str(folder / "owner"),
            "robots": [str(proxy)],
            "switch": str(switch),
            "watch": _WATCH,
            "uplink": uplink,
        }
        self._credentials.write(SITE, content)


def standing_runs(what: str) -> RunRegistry:
    """Return the records of runs of one kind, such as ``demo``, with machines of ``fog``.

    Raises ``LocalError``: the folder belongs to another user.
    """
    return RunRegistry(Path(tempfile.gettempdir()) / f"gdp-fog-{what}-{outer_uid()}")


def sweep(runs: RunRegistry) -> list[str]:
    """Take down the leftovers of killed runs; return their ids."""
    dead = [each.run for each in runs.all() if each.dead]
    for run in dead:
        end_all_of(runs.resume(run))
    return dead


def end_all_of(run: Run) -> None:
    """Release the machines of a run, and take down the rest.

    Raises ``LocalError``: machines remain; the text has the output of ``fog down``.
    """
    if (run.directory / STATE).exists():
        argv = [sys.executable, *fog_command(run, ["down", "--all"])]
        ended = subprocess.run(argv, capture_output=True, text=True, timeout=_DOWN_S, check=False)
        if ended.returncode:
            raise LocalError(f"run {run.id}: fog down: {(ended.stderr or ended.stdout).strip()}")
    run.end()


def fog_command(run: Run, words: Sequence[str]) -> list[str]:
    """Return Python's arguments to run ``fog`` in a run's folder."""
    site = run.directory / SITE
    options = ["--site", str(site)] if site.exists() else []
    return ["-m", "fog.cli.app", *words, *options, "--state", str(run.directory / STATE)]
