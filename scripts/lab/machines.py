"""Machines of a topology in namespaces, and the overlay's nodes on them: of benches, experiments and the ring.

I/O. ``lab.topology`` describes networks, ``Lab`` is the machines of one, ``OverlayNodes`` are switches and RIBs on a
lab. ``run.end()`` removes namespaces and processes of a lab, and the file systems of its machines' shared memory.
Source: shm_overview(7), mount_namespaces(7), unshare(1).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

from gdp.closing import ClosedOnExit
from gdp.crypto.certificates import Role
from gdp.host.mounts import mount_tmpfs
from gdp.host.run_registry import Run
from gdp.metadata import Metadata
from gdp.trust.right import Right
from lab.cores import MachineCores
from lab.credentials import Carried, OverlayCredentials, Side
from lab.machine import PROGRAMS, LabMachine
from lab.namespaces import Namespaces
from lab.process import ROOT, FailedError, LabProcess, end_processes, python_path
from lab.topology import Attachment, Topology

_SIZE_BYTES: Final = 256 << 20  # a limit, not a reservation
_ENTER: Final = 'mount --bind "$0" /dev/shm && exec "$@"'
_BENCH: Final = ROOT / "scripts" / "bench"
DELAY_LINE: Final = ("-m", "fog.providers.local.delay")  # a program that waits for a line; then two devices, and ms
_END_S: Final = 3.0

T = TypeVar("T")


class SharedMemory:
    """The ``/dev/shm`` of a machine. Raises ``LocalError``: the kernel refuses."""

    def __init__(self, run: Run, node: str) -> None:
        self.folder = run.directory / f"shm-{node}"
        run.plan_mount(self.folder)
        mount_tmpfs(self.folder, _SIZE_BYTES)

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` with this ``/dev/shm``, under the same process id."""
        return ["unshare", "--mount", "--propagation", "private", "--", "sh", "-c", _ENTER, str(self.folder), *argv]


class Lab:
    """Machines of a topology, each in a namespace.

    ``own_shared_memory``: these machines have a ``/dev/shm`` each; the others see the one of the host.
    ``dies_with_us``: whether the kernel kills what runs on them when this process ends in any way. ``cores``: bound of
    processor time by machine; None: the machines share all cores. Raises ``LocalError``: the kernel refuses.
    """

    def __init__(
        self,
        run: Run,
        topology: Topology,
        *,
        own_shared_memory: Sequence[str] = (),
        dies_with_us: bool = True,
    ) -> None:
        self.run = run
        self.directory = run.directory
        self.topology = topology
        self.namespaces = Namespaces(topology, run)
        self._memories = {node: SharedMemory(run, node) for node in own_shared_memory}
        self.cores: MachineCores | None = None
        self._dies_with_us = dies_with_us
        path = {"PYTHONPATH": python_path(_BENCH)}
        self.machines = {
            node: LabMachine(run.directory, self.command(node, []), run=run, environment=path)
            for node in topology.nodes
        }

    def inside(self, node: str, work: Callable[[], T]) -> T:
        """Call ``work`` in a machine's namespace."""
        return self.namespaces[node].inside(work)

    def command(self, node: str, argv: Sequence[str], environment: Sequence[str] = ()) -> list[str]:
        """Return the command line that runs ``argv`` on a machine; ``environment`` holds ``KEY=value``."""
        inner = ["env", *environment, *argv] if environment else list(argv)
        memory = self._memories.get(node)
        entered = memory.command(inner) if memory else inner
        return self.namespaces[node].command(entered, dies_with_us=self._dies_with_us)

    def start(
        self,
        node: str,
        what: str,
        arguments: Sequence[str],
        environment: Sequence[str] = (),
        *,
        heard: bool = True,
        has_orders: bool = False,
    ) -> LabProcess:
        """Start Python on a machine; with it ``what`` names its log, ``environment`` holds ``KEY=value``."""
        argv = [*(["env", *environment] if environment else []), sys.executable, *arguments]
        started = self.machines[node].launch(argv, f"{what}-{node}", heard=heard, has_orders=has_orders)
        if self.cores is not None:
            self.cores.add(node, started.pid)
        return started


class OverlayNodes(ClosedOnExit):
    """Switches and RIBs of a lab, with keys of their own; a context manager that ends them.

    ``credentials``: of the overlay; the files of the nodes are there before a node starts.
    """

    def __init__(self, lab: Lab, credentials: OverlayCredentials) -> None:
        self.lab = lab
        self.credentials = credentials
        self.running: dict[tuple[str, str], LabProcess] = {}  # by role and node

    def close(self) -> None:
        """End all processes."""
        end_processes(self.running.values(), _END_S)
        self.running.clear()

    def start(self, role: Literal["switch", "rib"], node: str, *words: str) -> LabProcess:
        """Start a node, also one that was killed; ``words``: more of its command line."""
        argv = ["-m", PROGRAMS[role], "--json", "--config", str(self.credentials.file(role, node)), *words]
        process = self.running[role, node] = self.lab.start(node, role, argv)
        return process

    def stand_up(
        self, switches: Sequence[str], plane: str, *rib_words: str, ready_s: float = 60.0
    ) -> list[dict[str, Any]]:
        """Write the files of switches and of all RIBs, and start them; return what each switch says when it is ready.

        ``plane``: as ``data_plane`` of ``switch.yaml``. Raises ``FailedError``: one does not come up.
        """
        for node in switches:
            self.credentials.switch(node, plane)
        said = [each.read(ready_s) for each in [self.start("switch", node) for node in switches]]
        ribs = self.credentials.topology.attached("rib")
        for at in ribs:
            self.credentials.rib(at)
        for each in [self.start("rib", at.switch, *rib_words) for at in ribs]:
            each.read(ready_s)
        return said


class BenchNodes(OverlayNodes):
    """All switches and RIBs of an overlay, running, and the members and proxies that it admits.

    Args:
        switches: nodes with one, in the order in which they start. A member at one of them is attached to it; another
            member is joined to its switch by a link.
        plane: as in ``stand_up``; any but ``auto`` must be the one that the switch takes.
        label: of the folder with keys; one lab may have several in turn.
        overlay: the lab's topology without what is no part of the overlay; None: all of it is.

    Attributes:
        planes: the data planes that the switches took.

    Raises:
        FailedError: a process did not come up.
    """

    def __init__(
        self,
        lab: Lab,
        switches: Sequence[str],
        *,
        plane: str,
        ready_s: float = 20.0,
        label: str = "keys",
        overlay: Topology | None = None,
    ) -> None:
        self._topology = overlay or lab.topology
        number = sum(1 for _ in lab.directory.glob(f"{label}-*"))
        self.files = lab.directory / f"{label}-{number}"
        self.files.mkdir(mode=0o700)
        super().__init__(lab, OverlayCredentials(self._topology, self.files))
        self._switch_nodes = tuple(switches)
        try:
            self.planes = {str(said.get("data_plane")) for said in self.stand_up(switches, plane, ready_s=ready_s)}
            if others := [taken for taken in self.planes if plane != "auto" and not taken.startswith(plane)]:
                raise FailedError(f"the switch took the data plane {', '.join(others)} instead of {plane}")
        except FailedError:
            self.close()
            raise

    def admit_member(self, node: str, topics: Mapping[Right, Iterable[str]]) -> Path:
        """Delegate topics to a member without ROS; return its configuration file."""
        for right, names in topics.items():
            for name in names:
                self.credentials.delegate(node, Metadata({"kind": "topic", "name": name}), right)
        content = {**self.credentials.node_yaml(Role.PROXY, node), "iface": self._iface(node)}
        return self.credentials.write(f"end-{node}.yaml", content)

    def admit_proxy(self, node: str, ros_domain: int, carried: Mapping[Side, Sequence[Carried]]) -> str:
        """Give a proxy the delegations of its sides, and write its configuration; return the file."""
        at = Attachment(node, "proxy", self._iface(node))
        return str(self.credentials.proxy(at, carried, ros={"endpoint": "ros2", "domain": ros_domain}))

    def _iface(self, node: str) -> str:
        if node in self._switch_nodes:
            (iface,) = (at.ifname for at in self._topology.attached("proxy") if at.switch == node)
            return iface
        return self._topology.neighbours(node)[0]
