"""Test bed of the benches and experiments: machines in namespaces, and the overlay's nodes on them.

I/O. ``lab.topology`` describes networks, ``Lab`` is the machines of one, ``OverlayNodes`` are switches and RIB on a
lab. ``run.end()`` removes namespaces and processes of a lab, and the file systems of its machines' shared memory.
Source: shm_overview(7), mount_namespaces(7), unshare(1).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final, TypeVar

from pyroute2 import IPRoute

from gdp.crypto.certificates import Role
from gdp.host.mounts import mount_tmpfs
from gdp.host.run_registry import Run
from gdp.metadata import Metadata
from gdp.trust.right import Right
from lab.credentials import Carried, OverlayCredentials, Side
from lab.namespaces import Namespaces
from lab.process import FailedError, LabProcess
from lab.topology import Attachment, Topology
from ring.cores import MachineCores

_SIZE_BYTES: Final = 256 << 20  # a limit, not a reservation
_ENTER: Final = 'mount --bind "$0" /dev/shm && exec "$@"'


class SharedMemory:
    """The ``/dev/shm`` of a machine. Raises ``LocalError``: the kernel refuses."""

    def __init__(self, run: Run, node: str) -> None:
        self.folder = run.directory / f"shm-{node}"
        run.plan_mount(self.folder)
        mount_tmpfs(self.folder, _SIZE_BYTES)

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` with this ``/dev/shm``, under the same process id."""
        return ["unshare", "--mount", "--propagation", "private", "--", "sh", "-c", _ENTER, str(self.folder), *argv]


_BENCH: Final = Path(__file__).resolve().parent

T = TypeVar("T")


class Lab:
    """Machines of a topology, each in a namespace.

    ``own_shared_memory``: these machines have a ``/dev/shm`` each; the others see the one of the host. ``cores``: bound
    of processor time by machine; None: the machines share all cores. Raises ``LocalError``: the kernel refuses.
    """

    def __init__(
        self,
        run: Run,
        topology: Topology,
        *,
        own_shared_memory: Sequence[str] = (),
        cores: Mapping[str, int] | None = None,
    ) -> None:
        self.run = run
        self.directory = run.directory
        self.topology = topology
        self.namespaces = Namespaces(topology, run)
        self._memories = {node: SharedMemory(run, node) for node in own_shared_memory}
        self._cores = MachineCores(run, dict(cores)) if cores else None

    def has_shared_memory(self, node: str) -> bool:
        """Return whether a machine has a ``/dev/shm`` of its own."""
        return node in self._memories

    def inside(self, node: str, work: Callable[[], T]) -> T:
        """Call ``work`` in a machine's namespace."""
        return self.namespaces[node].inside(work)

    def command(self, node: str, argv: Sequence[str], environment: Sequence[str] = ()) -> list[str]:
        """Return the command line that runs ``argv`` on a machine; ``environment`` holds ``KEY=value``."""
        inner = ["env", *environment, *argv] if environment else list(argv)
        memory = self._memories.get(node)
        return self.namespaces[node].command(memory.command(inner) if memory else inner)

    def start(
        self,
        node: str,
        what: str,
        arguments: Sequence[str],
        environment: Sequence[str] = (),
        *,
        has_orders: bool = False,
    ) -> LabProcess:
        """Start Python on a machine; ``what`` names its log, ``environment`` holds ``KEY=value``."""
        argv = self.command(node, [sys.executable, *arguments], environment)
        paths = {"PYTHONPATH": os.pathsep.join(filter(None, (str(_BENCH), os.getenv("PYTHONPATH"))))}
        started = LabProcess(self.run, f"{what} at {node}", argv, environment=paths, has_orders=has_orders)
        if self._cores is not None:
            self._cores.add(node, started.pid)
        return started


class OverlayNodes:
    """Switches and RIBs of a lab, running, with keys of their own; a context manager that ends them.

    Args:
        switches: nodes with one, in the order in which they start. A member at one of them is attached to it; another
            member is joined to its switch by a link.
        plane: as ``gdp-switch --data-plane``; any but ``auto`` must be the one that the switch takes.
        label: of the folder with keys; one lab may have several in turn.
        overlay: the lab's topology without what is no part of the overlay; None: all of it is.

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
        self.lab = lab
        self._topology = overlay or lab.topology
        number = sum(1 for _ in lab.directory.glob(f"{label}-*"))
        self.files = lab.directory / f"{label}-{number}"
        self.files.mkdir(mode=0o700)
        self.credentials = credentials = OverlayCredentials(self._topology, self.files)
        self._switch_nodes = tuple(switches)
        self.planes: set[str] = set()
        self.undo = ExitStack()
        with ExitStack() as undo:
            self.switches = []
            for node in switches:
                config = str(credentials.switch(node, "auto"))
                data_plane = [] if plane == "auto" else ["--data-plane", plane]
                argv = ["-m", "gdp.cli.switch", "--json", *data_plane, "--config", config]
                self.switches.append(undo.enter_context(lab.start(node, "switch", argv)))
            for switch in self.switches:
                taken = str(switch.read(ready_s).get("data_plane"))
                if plane != "auto" and not taken.startswith(plane):
                    raise FailedError(f"the switch took the data plane {taken} instead of {plane}")
                self.planes.add(taken)
            for at in self._topology.attached("rib"):
                rib = ["-m", "gdp.cli.rib", "--json", "--config", str(credentials.rib(at))]
                undo.enter_context(lab.start(at.switch, "rib", rib)).read(ready_s)
            self.undo = undo.pop_all()

    def close(self) -> None:
        """End all processes, the last one first."""
        self.undo.close()

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
        return next(self._topology.links_of(node)).other(node)


def add_address(device: str, address: str) -> None:
    """Give a device an IPv4 address of a network of 24 bits."""
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.addr("add", index=index, address=address, prefixlen=24)


def add_bridge(name: str, devices: Sequence[str] = ()) -> None:
    """Join devices by a new bridge without spanning tree."""
    with IPRoute() as here:
        here.link("add", ifname=name, kind="bridge", br_stp_state=0, br_forward_delay=0)
        (bridge,) = here.link_lookup(ifname=name)
        for device in devices:
            here.link("set", index=here.link_lookup(ifname=device)[0], master=bridge)
        here.link("set", index=bridge, state="up")


def add_neighbour(device: str, address: str, mac: bytes) -> None:
    """Name the MAC address of an IPv4 neighbour for good, so that nothing asks for it."""
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.neigh("add", dst=address, lladdr=mac.hex(":"), ifindex=index, state="permanent")


def set_link(device: str, **change: str | int) -> None:
    """Change a device: ``state``, ``mtu`` in bytes, or ``net_ns_fd``, the namespace of a descriptor to move it to."""
    with IPRoute() as here:
        here.link("set", index=here.link_lookup(ifname=device)[0], **change)


def received(devices: Sequence[str]) -> dict[str, int]:
    """Return how many frames have come in, by device."""
    with IPRoute() as here:
        links = {link.get_attr("IFLA_IFNAME"): link.get_attr("IFLA_STATS64") for link in here.get_links()}
    return {device: links[device]["rx_packets"] for device in devices}


def mac_addresses(devices: Sequence[str]) -> dict[str, bytes]:
    """Return the MAC addresses, by device."""
    with IPRoute() as here:
        links = {link.get("ifname"): link.get("address") for link in here.get_links()}
    return {device: bytes.fromhex(links[device].replace(":", "")) for device in devices}
