"""A local machine as it is found on disk: where everything of it is, and how it is.

I/O; it reads, and changes nothing.
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

__all__ = ["LocalMachine", "find", "list_machines"]


@dataclass(frozen=True, slots=True)
class LocalMachine:
    """A machine whose record is there.

    Attributes:
        host: the process that is the machine; None: it was not started yet.
    """

    record: Record
    file: MachineFile

    @property
    def id(self) -> str:
        """Return the id of the machine's run."""
        return self.record.run

    @property
    def directory(self) -> Path:
        """Return the folder of the machine."""
        return Path(self.record.files[0])

    @property
    def home(self) -> Path:
        """Return the machine's own folder."""
        return self.directory / "home"

    @property
    def space(self) -> Path:
        """Return the file of the machine's network namespace."""
        return space_path(self.id, self.directory, self.file.spec.name)

    @property
    def plug(self) -> str:
        """Return the far end of its device, in its gateway's namespace."""
        return f"m-{self.id}"

    @property
    def gateway(self) -> Path:
        """Return the namespace of its gateway."""
        return Path(self.file.gateway)

    @property
    def relay_out(self) -> str:
        """Return the device beyond its plug by which a relay sends on; see ``trouble.delay``."""
        return f"d-{self.id}"

    @property
    def relay_in(self) -> str:
        """Return the other end of that, which is in the segment then."""
        return f"e-{self.id}"

    @property
    def uplink_plug(self) -> str:
        """Return the far end of its second device, which it has while it is the gateway."""
        return f"g-{self.id}"

    @property
    def gateway_mark(self) -> Path:
        """Return the file that is there while it is the gateway."""
        return self.directory / "gateway"

    @property
    def address(self) -> str:
        """Return its own address: the id's three bytes."""
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
        """Return whether it runs, or its creator still works on it."""
        return not self.record.dead and (self.host is None or self.host.alive)

    def describe(self) -> Machine:
        """Return what the provider says of it."""
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
        """Return since when it has been so: by its own word, by whoever killed it, or by its notice."""
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
    """Return the machine of this id, or the one of this name if there is only one.

    Raises:
        LocalError: there is none.
    """
    everyone = list_machines(runs)
    found = [each for each in everyone if each.id == machine]
    found = found or [each for each in everyone if each.file.spec.name == machine]
    if len(found) != 1:
        known = ", ".join(f"{each.id} ({each.file.spec.cluster}/{each.file.spec.name})" for each in everyone)
        raise LocalError(f"no local machine {machine}; there are: {known or 'none'}")
    return found[0]
