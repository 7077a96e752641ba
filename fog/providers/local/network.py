"""Network of a site's gateways: namespaces connected to the robot and to each other as a tree.

I/O; needs root of the machine or of a user namespace. The network is one persistent run, described by ``network.json``
in its folder. A dedicated gateway has a switch in its namespace. A replica gateway has two bridges there: its switch is
that of a machine, which ``provider.py`` connects with both.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fog.host.bundle import install
from fog.machine import MachineBundle
from fog.providers.local.netlinks import (
    MACHINES,
    SEGMENT,
    UP,
    UPLINK_BRIDGE,
    delete,
    exists,
    join,
    make_bridge,
    make_segment,
    make_space,
    plug,
    space_path,
)
from fog.providers.local.spawn import spawn_detached
from fog.topology import Gateway
from gdp.errors import LocalError, StoreError
from gdp.host.processes import Process
from gdp.host.run_registry import Record, Run, RunRegistry

log = logging.getLogger(__name__)

GatewayBoot = Callable[[str, Sequence[str]], MachineBundle]

_FILE: Final = "network.json"


@dataclass(frozen=True, slots=True)
class _Standing:
    """Network with a record on disk; it may be down."""

    record: Record
    topology: Gateway

    def netns_path(self, label: str) -> Path:
        return space_path(self.record.run, Path(self.record.files[0]), label)

    def home(self, label: str) -> Path:
        return Path(self.record.files[0]) / label

    def is_up(self, label: str) -> bool:
        """Return whether the process of a gateway runs."""
        try:
            pid, started = json.loads((self.home(label) / "process.json").read_bytes())
        except (OSError, ValueError):
            return False
        return Process(pid, started).alive


class Network:
    """The single network of a site.

    Args:
        boot: returns a gateway's bundle for its label and its ports.
        uplink: the robot's end of its link to the first gateway, in the namespace of the caller of ``open``.
    """

    def __init__(self, runs: RunRegistry, topology: Gateway, boot: GatewayBoot, uplink: str) -> None:
        self._runs = runs
        self._topology = topology
        self._boot = boot
        self._uplink = uplink

    def open(self) -> None:
        """Create missing devices and start gateways that do not run; existing ones are unchanged.

        Raises:
            LocalError: the kernel refuses; the uplink is a foreign device; another topology is up.
        """
        standing = self._find()
        if standing is None or not standing.record.kept or standing.record.dead:
            self.close()
            self._make()
            return
        if standing.topology != self._topology:
            raise LocalError("the gateways that stand have another topology; 'fog down --all' first")
        run = self._runs.resume(standing.record.run)
        for gateway in self._topology.traverse():
            if not gateway.replica and not standing.is_up(gateway.gateway):
                log.warning("gateway started again gateway=%s", gateway.gateway)
                self._start(run, standing, gateway)

    def close(self) -> None:
        """Remove the network; no effect if there is none."""
        standing = self._find()
        if standing is not None:
            delete(None, self._uplink)  # otherwise the kernel removes it some time after its namespace
            self._runs.resume(standing.record.run).end()

    def gateway(self, region: str) -> Path:
        """Return the namespace of the gateway of a region's machines.

        Raises:
            LocalError: the network is not open.
        """
        standing = self._find()
        if standing is None or not standing.record.kept:
            raise LocalError("the local network is not open")
        return standing.netns_path(standing.topology.serving(region).gateway)

    def replica_gateway(self, region: str) -> str:
        """Return the label of the replica gateway of a region's machines; empty: their gateway is dedicated."""
        serving = self._topology.serving(region)
        return serving.gateway if serving.replica else ""

    def _find(self) -> _Standing | None:
        for record in self._runs.all():
            try:
                document = (Path(record.files[0]) / _FILE).read_bytes()
            except OSError:
                continue
            try:
                topology = Gateway.model_validate_json(document)
            except ValueError as error:  # pydantic's error is a ValueError
                raise StoreError(f"{record.files[0]}/{_FILE}: not the network that fog wrote: {error}") from error
            return _Standing(record, topology)
        return None

    def _make(self) -> None:
        if exists(None, self._uplink):
            raise LocalError(f"the device {self._uplink} is there already, and not ours")
        run = self._runs.start()
        try:
            (run.directory / _FILE).write_text(self._topology.model_dump_json(), encoding="utf-8")
            standing = _Standing(run.record, self._topology)
            gateways = list(self._topology.traverse())
            for gateway in gateways:
                space = standing.netns_path(gateway.gateway)
                run.plan_namespace(space)
                make_space(space, "")
                if gateway.replica:
                    make_bridge(space, SEGMENT)
                    make_bridge(space, UPLINK_BRIDGE)
                else:
                    make_segment(space)
            join(None, self._uplink, standing.netns_path(self._topology.gateway), UP)
            for gateway in gateways:
                for child in gateway.children:
                    ends = standing.netns_path(gateway.gateway), standing.netns_path(child.gateway)
                    join(ends[0], f"to-{child.gateway}", ends[1], UP)
            for gateway in gateways:
                if gateway.replica:
                    plug(standing.netns_path(gateway.gateway), UP, bridge=UPLINK_BRIDGE)
                else:
                    self._start(run, standing, gateway)
            if self._topology.replica:
                run.retain(passive=True)
        except BaseException:
            run.end()
            delete(None, self._uplink)
            raise

    def _start(self, run: Run, standing: _Standing, gateway: Gateway) -> None:
        home = standing.home(gateway.gateway)
        ports = (UP, *(f"to-{child.gateway}" for child in gateway.children), MACHINES)
        if not (home / "process.json").exists():
            install(home, self._boot(gateway.gateway, ports))
            (home / "logs").mkdir(mode=0o700, exist_ok=True)

        def note(pid: int) -> None:
            process = Process.from_pid(pid)
            (home / "process.json").write_text(json.dumps([process.pid, process.started]), encoding="ascii")

        argv = ["fog.host.cli", "--home", str(home), "--await-go"]
        spawn_detached(run, standing.netns_path(gateway.gateway), argv, home / "logs" / "machine.log", note)
