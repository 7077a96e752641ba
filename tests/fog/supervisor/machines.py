"""Machines for the tests of the supervisor's decisions: records, and a provider in a simulation of virtual seconds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from fog.cluster import MachineRequest
from fog.hardware import Hardware, Offer
from fog.machine import Machine, MachineSpec, MachineState
from fog.supervisor.core.reconcile import Drain, Launch, Release, Timeouts, decide
from fog.supervisor.core.record import IssuedCredentials, Record, update_record
from fog.supervisor.placement import place

NOW_S = 1_000_000.0
SPOT = MachineRequest(Hardware(cpus=2), is_spot=True)
REGIONS = ("east", "west", "south")


def offer(region: str = "east", *, is_spot: bool = True, usd: float = 0.1) -> Offer:
    """Return an offer of two processors."""
    return Offer("local", region, "small", Hardware(cpus=2, memory_gib=4), is_spot=is_spot, usd_per_hour=usd)


OFFERS = [offer(region) for region in REGIONS]


def record(
    name: str, region: str = "east", *, asked_s: float = NOW_S - 100.0, credential_renewal_s: float = 1e6
) -> Record:
    """Return a requested machine."""
    spec = MachineSpec("c", name, offer(region))
    return Record(
        spec, SPOT, IssuedCredentials(f"proxy-{name}", NOW_S + credential_renewal_s), asked_s, id=f"id-{name}"
    )


def serving(name: str, region: str = "east", **more: float) -> Record:
    """Return a machine whose replica is visible."""
    up_s = NOW_S - 90.0
    return replace(record(name, region, **more), state=MachineState.RUNNING, up_unix_s=up_s, served_unix_s=up_s)


@dataclass
class World:
    """Provider, overlay and clock, played against ``update_record``, ``place`` and ``decide``."""

    now_s: float = NOW_S
    boot_s: float = 3.0
    records: dict[str, Record] = field(default_factory=dict)
    machines: dict[str, Machine] = field(default_factory=dict)
    frozen: set[str] = field(default_factory=set)
    drained: dict[str, float] = field(default_factory=dict)
    made: int = 0

    def add(self, known: Record, state: MachineState, *, is_frozen: bool = False, is_known: bool = True) -> None:
        """Add a machine to the simulation, and to the journal if it is known."""
        self.machines[known.name] = Machine(known.id or f"id-{known.name}", known.spec, state, known.asked_unix_s)
        if is_frozen:
            self.frozen.add(known.name)
        if is_known:
            self.records[known.name] = known
        self.made = max(self.made, int(known.name[1:]))

    def serving(self) -> set[str]:
        """Return the machines whose replicas really take calls."""
        return {
            name
            for name, machine in self.machines.items()
            if machine.state in (MachineState.RUNNING, MachineState.LEAVING)
            and name not in self.frozen
            and name not in self.drained
        }

    def step(self, wanted: tuple[MachineRequest, ...], patience: Timeouts, seconds: float = 0.2) -> list[object]:
        """Advance time, observe, and apply the decisions; return them."""
        self.now_s += seconds
        for name, machine in list(self.machines.items()):
            if machine.state is MachineState.BOOTING and self.now_s - machine.started_unix_s >= self.boot_s:
                self.machines[name] = replace(machine, state=MachineState.RUNNING)
            leaves_s = machine.leaves_at_unix_s
            is_over = leaves_s is not None and self.now_s >= leaves_s
            if is_over or self.now_s - self.drained.get(name, self.now_s) >= 1.0:
                del self.machines[name]
        heard = self.serving()
        for name, known in self.records.items():
            learnt = update_record(known, self.machines.get(name), name in heard, self.now_s, grace_s=2.0)
            self.records[name] = learnt
        for name in self.machines.keys() - {each.name for each in self.records.values() if not each.is_gone}:
            del self.machines[name]  # orphans are given back
        actions = decide(wanted, list(self.records.values()), self.now_s, patience)
        for action in actions:
            self._do(action)
        return list(actions)

    def _do(self, action: object) -> None:
        match action:
            case Launch(wanted):
                choice = place(wanted, OFFERS, list(self.records.values()), self.now_s)
                if choice is not None:
                    self.made += 1
                    name = f"m{self.made}"
                    spec = MachineSpec("c", name, choice.offer)
                    issued_credentials = IssuedCredentials(f"proxy-{name}", self.now_s + 1e6)
                    self.records[name] = Record(spec, wanted, issued_credentials, self.now_s, id=f"id-{name}")
                    self.machines[name] = Machine(f"id-{name}", spec, MachineState.BOOTING, self.now_s)
            case Drain(name, reason):
                self.records[name] = replace(self.records[name], drained_unix_s=self.now_s, reason=reason)
                self.drained[name] = self.now_s
            case Release(name, reason, ending):
                known = replace(self.records[name], released_unix_s=self.now_s, reason=reason, ending=ending)
                self.records[name] = known
                self.machines.pop(name, None)
