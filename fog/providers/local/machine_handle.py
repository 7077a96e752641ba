"""Handle of a local machine found on disk: its paths, devices and state.

I/O; reads only.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fog.host.preemption_notice import given_unix_s, read_notice
from fog.host.status import Status
from fog.machine import Machine, MachineState
from fog.providers.local.machine_file import MachineFile
from fog.providers.local.netlinks import space_path
from gdp.errors import LocalError
from gdp.host.cgroups import Cgroup
from gdp.host.processes import Process
from gdp.host.run_registry import Record, RunRegistry


@dataclass(frozen=True, slots=True)
class LocalMachine:
    """Machine with a record on disk.

    Attributes:
        host: process of the machine agent; None: not started yet.
    """

    record: Record
    file: MachineFile

    @property
    def id(self) -> str:
        """Return the id of the machine's run."""
        return self.record.run

    @property
    def directory(self) -> Path:
        """Return the folder of the machine's run."""
        return Path(self.record.files[0])

    @property
    def home(self) -> Path:
        """Return the machine's home folder, for the machine agent."""
        return self.directory / "home"

    @property
    def netns_path(self) -> Path:
        """Return the path of the machine's network namespace."""
        return space_path(self.id, self.directory, self.file.spec.name)

    @property
    def gateway_device(self) -> str:
        """Return the device name of its link's other end, in its gateway's namespace."""
        return f"m-{self.id}"

    @property
    def gateway(self) -> Path:
        """Return the path of its gateway's namespace."""
        return Path(self.file.gateway)

    @property
    def relay_out(self) -> str:
        """Return the device behind ``plug`` to which a delay relay sends; see ``fault_injection.delay``."""
        return f"d-{self.id}"

    @property
    def relay_in(self) -> str:
        """Return the other end of ``relay_out``, which is then in the segment."""
        return f"e-{self.id}"

    @property
    def uplink_plug(self) -> str:
        """Return the other end of its second device, which exists while it is the gateway."""
        return f"g-{self.id}"

    @property
    def gateway_mark(self) -> Path:
        """Return the path of a file that exists while it is the gateway."""
        return self.directory / "gateway"

    @property
    def address(self) -> str:
        """Return its loopback address, which contains the id's three bytes."""
        return ".".join(map(str, (10, *bytes.fromhex(self.id))))

    @property
    def cgroup(self) -> Cgroup:
        """Return the control group of the machine's processes."""
        return Cgroup(f"gdp-{self.id}")

    @property
    def host(self) -> Process | None:
        """Return the process that runs the machine's programs."""
        return next(iter(self.record.processes), None)

    @property
    def is_alive(self) -> bool:
        """Return whether it runs or is still being created."""
        return not self.record.dead and (self.host is None or self.host.alive)

    def describe(self) -> Machine:
        """Return the provider's description of it."""
        state, reason = self._state()
        return Machine(
            self.id,
            self.file.spec,
            state,
            self.file.started_unix_s,
            address=self.address,
            leaves_at_unix_s=read_notice(self.home),
            reason=reason,
            since_unix_s=self._since_unix_s(state),
            is_gateway=self.gateway_mark.exists(),
        )

    def _since_unix_s(self, state: MachineState) -> float | None:
        """Return the start of its state: from its status, from the record of its kill, or from its notice."""
        if state is MachineState.LEAVING and (given_s := given_unix_s(self.home)) is not None:
            return given_s
        said = Status.read(self.home)
        if said is not None and said.state is state:
            return said.changed_unix_s
        return (self.file.gone_unix_s or read_notice(self.home)) if state is MachineState.GONE else None

    def _state(self) -> tuple[MachineState, str]:
        said, notice = Status.read(self.home), read_notice(self.home)
        if not self.is_alive:
            if said is not None and said.state in (MachineState.LEAVING, MachineState.GONE):
                return MachineState.GONE, said.reason
            return MachineState.GONE, "preempted" if notice is not None else "killed"
        if notice is not None:
            return MachineState.LEAVING, "preempted"
        return (MachineState.BOOTING, "") if said is None else (said.state, said.reason)


def list_machines(runs: RunRegistry, cluster: str | None = None) -> list[LocalMachine]:
    """Return the machines of a cluster, or of all."""
    files = ((record, MachineFile.read(Path(record.files[0]))) for record in runs.all())
    found = [LocalMachine(record, file) for record, file in files if file is not None]
    return [each for each in found if cluster is None or each.file.spec.cluster == cluster]


def find(runs: RunRegistry, machine: str) -> LocalMachine:
    """Return the machine with this id, or with this name if it is unique.

    Raises:
        LocalError: there is no such machine.
    """
    everyone = list_machines(runs)
    found = [each for each in everyone if each.id == machine]
    found = found or [each for each in everyone if each.file.spec.name == machine]
    if len(found) != 1:
        known = ", ".join(f"{each.id} ({each.file.spec.cluster}/{each.file.spec.name})" for each in everyone)
        raise LocalError(f"no local machine {machine}; there are: {known or 'none'}")
    return found[0]
