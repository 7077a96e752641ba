"""Overlay of a plan: its real processes and links, and every fault that can be made there.

I/O. Namespaces and processes through ``lab.namespaces``, the commands that robots run, and ``faults.member`` at the
ends. A process is called ``switch s1``, ``rib s1`` or ``member m1``. Each may be killed, restarted, frozen.
"""

from __future__ import annotations

import json
import signal
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Final

from report import progress

from faults.accounts import Books
from faults.clock import Clock
from faults.link_faults import FrameFaults, LinkFaults
from faults.plan import Plan, Service
from faults.records import Record, RecordReader
from faults.schedule import KILLS
from faults.store import Disk, StoreCluster
from gdp.closing import ClosedOnExit
from gdp.crypto.certificates import Role
from gdp.errors import LocalError
from gdp.host.run_registry import Run
from gdp.journal.incident import Incident
from gdp.management.control_client import NodeConnection, find_control_socket
from gdp.metadata import Metadata
from gdp.stores.keyring import NODE_CERTIFICATE
from gdp.trust.right import Right
from lab.credentials import OverlayCredentials
from lab.faults import STORE, Fault, FaultKind, links_of
from lab.machine import gdp
from lab.machines import Lab
from lab.process import FailedError, LabProcess, end_processes, until

READY_S: Final = 60.0
LOOK_S: Final = 0.1
FRAMES: Final = {
    FaultKind.SILENT: FrameFaults(lost=1.0),
    FaultKind.LOSS: FrameFaults(lost=0.05),
    FaultKind.DOUBLED: FrameFaults(doubled=0.2),
    FaultKind.REORDERED: FrameFaults(delayed=0.2, delay_s=0.02),
}
JOURNAL_MIB: Final = 64  # about two hours of a switch, or what it takes in a minute of chaos
_BUCKET_BYTES: Final = 4_000  # of a thin link; two frames


class Overlay(ClosedOnExit):
    """Network of a plan; a context manager that removes everything.

    Args:
        run: run that owns the namespaces and processes.
        plan: the nodes.
        has_clocks: processes may have their wall clock stepped.
        more: further keys of the file of every switch and RIB, by role.
        has_journals: switches and RIBs keep journals.
        has_disk: RIBs keep snapshots on a small disk.
        in_store: switches whose RIBs share a cluster of servers; they keep no snapshots.

    Attributes:
        processes: what was started and not killed; it may have ended by itself.
        lives: every process that was started, by name.
        active: faults that have begun and not ended.
        at: the switch that each member, or switch that moves, is plugged into.
        spaces: the namespaces, in which links can be cut.
        links: the frames of links, which can be disturbed.
        books: what the members have recorded, as far as ``watch`` has read it.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up.
    """

    def __init__(
        self,
        run: Run,
        plan: Plan,
        *,
        has_clocks: bool = False,
        has_journals: bool = False,
        more: Mapping[str, Mapping[str, object]] | None = None,
        has_disk: bool = False,
        in_store: Sequence[str] = (),
    ) -> None:
        self.plan = plan
        self.directory = run.directory
        self._lab = Lab(run, plan.topology)
        self._run = run
        journal = {"journal": JOURNAL_MIB} if has_journals else {}
        self._more = {role: {**journal, **(more or {}).get(role, {})} for role in ("switch", "rib")}
        self.at = {mover: plan.home(mover) for mover in (*plan.homes, *plan.members)}
        self.lives: defaultdict[str, list[LabProcess]] = defaultdict(list)
        self.processes: dict[str, LabProcess] = {}
        self.active: list[Fault] = []
        self._records: defaultdict[str, list[RecordReader]] = defaultdict(list)
        self.spaces = self._lab.namespaces
        self.books = Books(plan)
        self._credentials = OverlayCredentials(plan.topology, run.directory)
        self._clocks: dict[str, Clock] = {}
        if has_clocks:
            (run.directory / "clocks").mkdir()
            self._clocks = {who: Clock(run.directory / "clocks" / who.replace(" ", "-")) for who in self.everybody()}
        self.links = LinkFaults(self.spaces)
        self.disk = Disk(run) if has_disk else None
        self.store = StoreCluster(run, self.spaces, in_store) if in_store else None
        self._in_store = frozenset(in_store)
        for member in plan.members:
            self._admit(member)

    def close(self) -> None:
        """End all processes, and remove the faults."""
        self.links.close()
        if self.store is not None:
            self.store.close()
        for who in self.processes:
            self.thaw(who)
        end_processes(list(self.processes.values()))  # all at once

    def everybody(self) -> list[str]:
        """Return every process by name."""
        return [
            *(f"switch {node}" for node in self.plan.switches),
            *(f"rib {node}" for node in self.plan.ribs),
            *(f"member {node}" for node in self.plan.members),
        ]

    # faults

    def begin(self, fault: Fault) -> None:
        """Make a fault happen. Raises ``FailedError``: a process that it restarts does not come up."""
        self.active.append(fault)
        self._changes(fault)[0]()
        for link in links_of(fault):
            self.spaces.cut(*link)

    def end(self, fault: Fault) -> None:
        """Undo a fault that can be undone; a killed process is ready then. Raises as ``begin``."""
        self.active.remove(fault)
        self._changes(fault)[1]()
        for link in links_of(fault):
            self.spaces.restore_link(*link)

    def _changes(self, fault: Fault) -> tuple[Callable[[], object], Callable[[], object]]:
        """Return what makes a fault and what undoes it, but for links that lose their carrier."""
        kind, targets = fault.kind, fault.targets
        if kind in FRAMES:
            a, b = targets
            return partial(self.links.set, a, b, FRAMES[kind]), partial(self.links.clear, a, b)
        if kind in KILLS:
            return partial(self.kill, targets[0]), partial(self.restart, targets[0])
        if kind is FaultKind.FREEZE:
            return partial(self.freeze, targets[0]), partial(self.thaw, targets[0])
        if kind is FaultKind.CLOCK:
            step = self._clocks[targets[0]].step
            return partial(step, fault.amount), partial(step, 0.0)
        if kind is FaultKind.ROAM:
            return partial(self.move, *targets), _nothing
        if kind is FaultKind.REVOKE:
            return partial(self.revoke, targets[0]), _nothing
        if kind is FaultKind.DISK_FULL and self.disk is not None:
            return partial(self._fill, self.disk, targets[1:]), self.disk.free
        if self.store is not None and targets[0] == STORE:
            store = self.store
            return lambda: progress(f"           {store.take(fault)}"), partial(store.give_back, fault)
        return _nothing, _nothing

    def _fill(self, disk: Disk, ribs: Sequence[str]) -> None:
        """Fill the disk, and start RIBs again while it is full."""
        disk.fill()
        for rib in ribs:
            self.kill(rib)
            self.restart(rib)

    # processes

    def start_all(self) -> None:
        """Start switches, RIBs, members; return when each reports that it is ready."""
        for role in ("switch", "rib", "member"):
            names = [who for who in self.everybody() if who.startswith(role)]
            for who in names:
                self.start(who)
            for who in names:
                self.processes[who].read(READY_S)

    def start(self, who: str) -> None:
        """Start a process, also one that was killed, with a new incarnation; does not wait for it."""
        role, _, node = who.partition(" ")
        incarnation_id = len(self.lives[who]) + 1
        if role == "switch":
            argv = ["gdp.cli.switch", "--json", "--config", str(self._switch_file(node))]
        elif role == "rib":
            argv = ["gdp.cli.rib", "--json", "--config", str(self._rib_file(node))]
        else:
            records = self.directory / f"{node}-{incarnation_id}.records"
            self._records[node].append(RecordReader(records))
            argv = ["faults.member", json.dumps(self._settings(node, incarnation_id, records))]
        clock = self._clocks.get(who)
        argv = ["-m", *argv] if clock is None else ["-m", "faults.clock", str(clock.path), *argv]
        self.processes[who] = self._lab.start(node, f"{role}-{incarnation_id}", argv)
        self.lives[who].append(self.processes[who])

    def restart(self, *names: str) -> None:
        """Start processes, and read records until each is ready: it joins the network then."""
        for who in names:
            self.start(who)
        for who in names:
            until(partial(self.processes[who].has_line, 0.0), who, READY_S, lambda: self.watch(LOOK_S))

    def kill(self, who: str) -> None:
        """Kill a process at once (SIGKILL)."""
        self.processes.pop(who).kill_group()

    def died(self) -> list[str]:
        """Return the processes that ended by themselves."""
        return [who for who, process in self.processes.items() if process.code is not None]

    def freeze(self, who: str) -> None:
        """Stop a process (SIGSTOP)."""
        self.processes[who].send(signal.SIGSTOP)

    def thaw(self, who: str) -> None:
        """Continue a frozen process; harmless when it is not frozen, or was killed."""
        if who in self.processes:
            self.processes[who].send(signal.SIGCONT)

    def read(self, member: str) -> Iterator[tuple[int, Iterator[Record]]]:
        """Yield, by incarnation, what a member recorded since the last call."""
        yield from ((number, records.read()) for number, records in enumerate(self._records[member], 1))

    def watch(self, seconds: float, *, is_strict: bool = False) -> None:
        """Read into the books what members record, for so long.

        Raises ``FailedError``: with ``is_strict``, a process ended by itself, or a member had a message of another.
        """
        end_s = time.monotonic() + seconds
        while True:
            for who in self.died() if is_strict else ():
                raise self.processes[who].failed("ended by itself")
            for member in self.plan.members:
                for incarnation_id, records in self.read(member):
                    self.books.take(member, incarnation_id, records)
            if is_strict and self.books.wrong:
                raise FailedError(self.books.wrong[0])
            if (left_s := end_s - time.monotonic()) <= 0:
                return
            time.sleep(min(LOOK_S, left_s))

    def keeps_snapshot(self, node: str) -> bool:
        """Return whether the RIB at a switch keeps a snapshot on the disk."""
        return self.disk is not None and node not in self._in_store

    def logs(self, who: str) -> Iterator[tuple[int, str]]:
        """Yield each incarnation of a process, and its whole log."""
        yield from ((number, process.logged) for number, process in enumerate(self.lives[who], 1))

    def save_journals(self, folder: Path) -> None:
        """Write the incident of each switch and RIB that runs; not sealed, because the keys of a run end with it."""
        folder.mkdir(parents=True, exist_ok=True)
        for who in self.processes:
            role, _, node = who.partition(" ")
            if role == "member":
                continue
            try:
                path = find_control_socket(self.directory / "nodes" / f"{role}-{node}")
                with NodeConnection(path) as connection:
                    incident = Incident.from_blocks(*connection.journal())
            except LocalError as error:
                progress(f"no journal of {who}: {error}")
                continue
            (folder / f"{role}-{node}.incident").write_bytes(incident.to_bytes())

    # links

    def revoke(self, member: str) -> None:
        """Revoke a member's membership: each switch receives the statement."""
        gdp(*self.revocation(member))
        for node in self.plan.switches:
            if f"switch {node}" in self.processes:
                self.processes[f"switch {node}"].send(signal.SIGHUP)

    def revocation(self, member: str) -> list[str]:
        """Return the words of ``gdp`` that revoke a membership, into a file that switches read at the next SIGHUP."""
        certificate = self._credentials.identity(Role.PROXY, member) / NODE_CERTIFICATE
        domain = self._credentials.domain(self.plan.topology.domain_of(member).label)
        out = self.directory / "revocations" / f"{member}.revoke"
        return ["cert", "revoke", str(certificate), "--domain", str(domain), "--out", str(out)]

    def make_thin(self, a: str, b: str, bits_s: float, fifo_s: float) -> None:
        """Give a link a rate and a plain FIFO, both ways, to the end of the run."""
        limit = max(round(bits_s / 8 * fifo_s), _BUCKET_BYTES)
        shape = f"tbf rate {bits_s:.0f}bit burst {_BUCKET_BYTES} limit {limit}"  # before the bucket, frames wait
        for own, other in ((a, b), (b, a)):
            self.spaces[own].run("tc", "qdisc", "add", "dev", other, "root", *shape.split())

    def move(self, mover: str, to: str) -> None:
        """Pull the cable of a mover at its switch and plug it into another one; the mover keeps its device."""
        self.spaces[self.at[mover]].move(mover, self.spaces[to])
        self.spaces[to].configure([f"link set dev {mover} up"])
        self.at[mover] = to

    # files

    def _switch_file(self, node: str) -> Path:
        movers = {mover for mover, homes in self.plan.homes.items() if node in homes}
        ports = [port for port in self._credentials.ports(node) if port["iface"] not in movers]
        ports += [{"iface": mover, "optional": True} for mover in sorted(movers)]
        revocations = self.directory / "revocations"
        revocations.mkdir(exist_ok=True)
        further = {"ports": ports, "revocations": str(revocations), **self._more["switch"]}
        return self._credentials.switch(node, "auto", **further)

    def _rib_file(self, node: str) -> Path:
        at = next(at for at in self.plan.topology.attached("rib") if at.switch == node)
        domain = self.plan.topology.domain_of(node)
        further: dict[str, object] = {"upper": self._rib_names(domain.upper)}
        if self.store is not None and node in self._in_store:
            further |= self.store.config
        else:
            further["peers"] = self._rib_names(domain.label, but=node)
            if self.disk is not None:
                further["snapshot"] = str(self.disk.snapshot(node))
        return self._credentials.rib(at, **{**further, **self._more["rib"]})

    def _rib_names(self, label: str | None, but: str = "") -> list[str]:
        """Return the names of the RIBs of a domain, but for the one at a switch."""
        switches = [at for at in self.plan.ribs if self.plan.topology.domain_of(at).label == label and at != but]
        return [self._credentials.name(Role.RIB, at).to_text() for at in switches]

    def _settings(self, member: str, incarnation_id: int, records: Path) -> dict[str, object]:
        """Return the settings of a member process: its identity, and its flows and services.

        The token of a channel begins each of its messages, and no other channel's.
        """
        run = struct.pack("!I", int(self._run.id, 16))
        return {
            "config": str(self.directory / f"end-{member}.yaml"),
            "records": str(records),
            "member": member,
            "index": self.plan.members.index(member),
            "incarnation_id": incarnation_id,
            "channels": [
                {**asdict(what), "channel": channel, "token": (run + struct.pack("!I", channel)).hex()}
                for channel, what in self.plan.channels(member)
            ],
        }

    def _admit(self, member: str) -> None:
        """Give a member its delegations, and write its configuration."""
        for _, what in self.plan.channels(member):
            if isinstance(what, Service):
                right = Right.SERVE if member in what.servers else Right.CALL
                metadata = Metadata({"kind": "service", "name": what.name})
            else:
                right = Right.PUBLISH if member == what.publisher else Right.READ
                metadata = Metadata({"kind": "topic", "name": what.topic})
            self._credentials.delegate(member, metadata, right)
        iface = self.plan.home(member)  # a device has the name of the neighbour it first leads to
        self._credentials.write(
            f"end-{member}.yaml", {**self._credentials.node_yaml(Role.PROXY, member), "iface": iface}
        )


def _nothing() -> None:
    """Neither make nor undo anything."""
