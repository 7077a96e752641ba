"""Provider of machines on this host: each is a network namespace with its own address, processes and limits.

I/O; needs root of the machine or of a user namespace. A machine is a persistent run (``gdp.host.run_registry``) with
``machine.json`` in its folder. The folder contains the whole state, so later processes find it, also after a crash.
Machines continue to run when their creator is killed, like machines of a cloud.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from fog.catalog.prices import LOCAL_REGIONS, local_offers
from fog.hardware import Hardware, Offer
from fog.host.bounded_log import last_lines
from fog.host.bundle import install
from fog.machine import Machine, MachineBundle, MachineSpec, MachineState
from fog.providers.local.fault_injection import hold, is_sold_out, kill
from fog.providers.local.machine_file import MachineFile
from fog.providers.local.machine_handle import LocalMachine, find, list_machines
from fog.providers.local.netlinks import MACHINE_DEVICE, UP, UPLINK_BRIDGE, delete, exists, join, make_space, plug
from fog.providers.local.network import GatewayBoot, Network
from fog.providers.local.spawn import spawn_detached
from fog.topology import AUTOMATIC, Gateway
from gdp.errors import LocalError, StoreError
from gdp.host.netns_files import reach
from gdp.host.processes import end_all
from gdp.host.run_registry import Run, RunRegistry
from gdp.intervals import STOP_S

log = logging.getLogger(__name__)

UPLINK: Final = "fog0"
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,40}")
_GONE_S: Final = 600.0  # its logs remain readable for this time
_GIB: Final = 1 << 30


class LocalProvider:
    """``Provider`` of namespaces.

    Args:
        gateway_boot: returns a gateway's bundle for its label and its ports.
        uplink: the robot's end of its link to the first gateway, in the namespace of the caller of ``open_network``.
        regions: offered in addition to the provider's own; it simulates any region.

    Raises:
        LocalError: the directory belongs to another user.
    """

    name = "local"
    poll_s = 0.2
    uplink_iface = UP

    def __init__(
        self,
        directory: Path,
        gateway_boot: GatewayBoot,
        topology: Gateway = AUTOMATIC,
        *,
        uplink: str = UPLINK,
        regions: Sequence[str] = (),
    ) -> None:
        self._directory = directory
        self.runs = RunRegistry(directory)  # also for ``fault_injection``
        self._network = Network(self.runs, topology, gateway_boot, uplink)
        named = [region for gateway in topology.traverse() for region in gateway.regions]
        self._regions = tuple(dict.fromkeys((*LOCAL_REGIONS, *named, *regions)))

    # the network

    def open_network(self) -> None:
        """Create the gateways and the uplink, and start gateways that do not run; existing ones are unchanged.

        The uplink exists afterwards, so a switch with a port on it can start.
        """
        with self._alone():
            self._network.open()

    def close_network(self) -> None:
        """Remove gateways and uplink. Existing machines lose their links."""
        with self._alone():
            self._network.close()

    def sweep(self) -> list[str]:
        """Remove runs that ended, or whose creator died before they were complete; return their ids."""
        gone = [each.id for each in list_machines(self.runs) if not each.is_alive]
        self.terminate(gone)
        with self._alone():
            return [*gone, *self.runs.sweep()]

    # the Provider protocol

    def offers(self, hardware: Hardware, *, spot: bool) -> list[Offer]:
        """Return the offers of this host's machines, cheapest first."""
        everything = local_offers(self._regions)
        fitting = [each for each in everything if each.is_spot == spot and hardware.fits(each.hardware)]
        return sorted(fitting, key=lambda each: each.usd_per_hour)

    def create(self, spec: MachineSpec, boot: MachineBundle) -> str:
        """Create a machine on this host and start its programs; return its id.

        Raises:
            LocalError: the name is none.
            StoreError: spot machines are sold out, or the kernel refuses.
        """
        if not _NAME.fullmatch(spec.name):
            raise LocalError(f"machine {spec.name!r}: a name has letters, digits, '-' and '_'")
        with self._alone():
            for each in list_machines(self.runs, spec.cluster):
                if each.file.spec.name == spec.name:
                    return each.id  # a repeated request: the requester was killed before it stored the id
            if spec.offer.is_spot and is_sold_out(self._directory):
                raise StoreError(f"machine {spec.name}: no spot machine is to be had there now")
            gateway = self._network.gateway(spec.offer.region)
            run = self.runs.start()
            file = MachineFile(spec, time.time(), str(gateway))
            file.write(run.directory)
        try:
            self._make(run, file, boot)
        except OSError as error:
            run.end()
            raise StoreError(f"machine {spec.name}: {error}") from error
        except BaseException:
            run.end()
            raise
        return run.id

    def describe(self, cluster: str) -> list[Machine]:
        """Return the machines of a cluster as they are now."""
        now_unix_s = time.time()
        machines = []
        for each in list_machines(self.runs, cluster):
            machine = each.describe()
            if machine.state is MachineState.GONE:
                if self._is_forgotten(each, now_unix_s):
                    continue
            elif machine.leaves_at_unix_s is not None and machine.leaves_at_unix_s < now_unix_s:
                kill(self.runs, each.id)  # a stopped machine cannot end itself
                machine = replace(machine, state=MachineState.GONE)
            machines.append(machine)
        return machines

    def terminate(self, ids: Sequence[str]) -> None:
        """End machines in parallel and remove their resources; other processes may do the same concurrently."""
        machines = [each for each in list_machines(self.runs) if each.id in ids]
        if new := [each.id for each in machines if not (each.record.kept or each.record.dead)]:
            raise StoreError(f"just being made: {', '.join(new)}")
        for each in machines:
            hold(each, held=False)
        end_all([each.host for each in machines if each.host is not None], STOP_S)
        for each in machines:
            for device in (each.gateway_device, each.uplink_plug, each.relay_out):
                delete(each.gateway, device)  # otherwise the kernel removes it some time after its namespace
            with self._alone():  # a command and the supervisor may end the same machine
                if each.id in {record.run for record in self.runs.all()}:
                    self.runs.resume(each.id).end()

    def drain(self, machine: str) -> None:
        """Let a machine finish its calls, and end its programs."""
        found = find(self.runs, machine)
        if found.host is not None and found.host.alive:
            with suppress(ProcessLookupError):
                os.kill(found.host.pid, signal.SIGUSR1)

    def replica_gateway(self, region: str) -> str:
        """Return the label of the replica gateway of a region's machines; empty: their gateway is dedicated."""
        return self._network.replica_gateway(region)

    def attach_uplink(self, machine: str) -> None:
        """Connect a machine to the uplink of its group."""
        with self._alone():
            found = find(self.runs, machine)
            if not self.replica_gateway(found.file.spec.offer.region):
                raise LocalError(f"machine {machine}: the gateway of {found.file.spec.offer.region} is dedicated")
            if not exists(found.gateway, found.uplink_plug):
                join(found.gateway, found.uplink_plug, found.netns_path, UP)
            plug(found.gateway, found.uplink_plug, bridge=UPLINK_BRIDGE)
            found.gateway_mark.touch()

    def detach_uplink(self, machine: str) -> None:
        """Disconnect a machine from the uplink."""
        with self._alone():
            for each in list_machines(self.runs):
                if each.id == machine:
                    delete(each.gateway, each.uplink_plug)
                    each.gateway_mark.unlink(missing_ok=True)

    def log(self, machine: str, program: str, lines: int) -> str:
        """Return the last lines of a program's log; without a program, of the machine's own log."""
        if not _NAME.fullmatch(program or "machine"):
            raise LocalError(f"no program {program!r}")
        return last_lines(find(self.runs, machine).home / "logs" / f"{program or 'machine'}.log", lines)

    def shell(self, machine: str) -> list[str]:
        """Return the command line of a shell inside a machine."""
        found = find(self.runs, machine)
        inside = ["env", f"--chdir={found.home}", f"FOG_MACHINE={found.file.spec.name}", "bash"]
        return ["nsenter", f"--net={reach(found.netns_path) or found.netns_path}", "--", *inside]

    def close(self) -> None:
        """Do nothing; the provider holds no resources."""

    def _make(self, run: Run, file: MachineFile, boot: MachineBundle) -> None:
        machine = LocalMachine(run.record, file)
        run.plan_namespace(machine.netns_path)
        make_space(machine.netns_path, machine.address)
        join(machine.gateway, machine.gateway_device, machine.netns_path, MACHINE_DEVICE)
        plug(machine.gateway, machine.gateway_device)
        install(machine.home, boot)
        (machine.home / "logs").mkdir(mode=0o700, exist_ok=True)

        def confine(pid: int) -> None:
            group, hardware = machine.cgroup, file.spec.offer.hardware
            run.plan_cgroup(group.name)
            is_bounded = group.make()
            if is_bounded:
                group.limit_cpu(hardware.cpus or None)
                group.limit_memory(int(hardware.memory_gib * _GIB) or None)
            else:
                log.warning("no bounds on processor time and memory here machine=%s", run.id)
            group.add(pid)
            replace(file, is_bounded=is_bounded).write(run.directory)

        argv = ["fog.host.cli", "--home", str(machine.home), "--await-go"]
        spawn_detached(run, machine.netns_path, argv, machine.home / "logs" / "machine.log", confine)

    def _is_forgotten(self, machine: LocalMachine, now_unix_s: float) -> bool:
        """Record when it was first observed as gone, and remove it after ``_GONE_S``; return whether it was removed."""
        if machine.file.gone_unix_s is None:
            with self._alone(), suppress(OSError):  # another process has removed it
                replace(machine.file, gone_unix_s=now_unix_s).write(machine.directory)
            return False
        if now_unix_s - machine.file.gone_unix_s < _GONE_S:
            return False
        self.terminate([machine.id])
        return True

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Exclude all other changes of this site's machines, by any process."""
        with (self._directory / ".lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield
