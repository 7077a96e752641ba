"""Kernel namespaces, and the realisation of a topology: one namespace per switch, one veth pair per link.

I/O; needs root of the machine or of a user namespace.
Devices of a topology have no addresses and no IPv6: all traffic on them is ours. On every end the device has the name
of the neighbour that it leads to. Its MAC encodes both switches (``02:67:64:70:AA:BB``, the AA-th towards the BB-th).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import subprocess
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from pyroute2 import IPRoute, netns

from gdp.errors import LocalError
from gdp.host import netns_files
from gdp.host.run_registry import Run, in_first_user_namespace
from gdp.ports.rtnetlink import LinkMonitor
from lab.topology import Link, Topology

_PATIENCE_S: Final = 10.0
_HERE: Final = "/proc/thread-self/ns/net"
_LIBC: Final = ctypes.CDLL(None, use_errno=True)

T = TypeVar("T")
_SpaceT = TypeVar("_SpaceT", bound="Space")


class Namespace:
    """A network namespace.

    ``label``: part of its name; unique in the run. ``path``: the file that holds it. Raises ``LocalError``: the kernel
    refuses.
    """

    def __init__(self, run: Run, label: str) -> None:
        folder = netns_files.IP_NETNS_DIRECTORY if in_first_user_namespace() else run.directory / "netns"
        self.path = folder / f"gdp-{run.id}-{label}"
        run.plan_namespace(self.path)
        netns_files.create(self.path)

    def inside(self, work: Callable[[], T]) -> T:
        """Call ``work`` in a thread inside, and return its result; a socket made there stays there."""
        return netns_files.inside(self.path, work)

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Move this thread, and the processes that it starts, into the namespace; leaving moves it back."""
        before = os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)
        try:
            with self.path.open("rb") as there:
                netns.setns(there.fileno())
            yield
        finally:
            netns.setns(before)
            os.close(before)

    def command(self, argv: Sequence[str], *, dies_with_us: bool = True) -> list[str]:
        """Return the command line that runs ``argv`` inside, under the same process id.

        ``dies_with_us``: whether the kernel kills it when the thread that starts it ends in any way.
        """
        leash = ["setpriv", "--pdeathsig", "KILL", "--"] if dies_with_us else []
        return ["nsenter", f"--net={self.path}", "--", *leash, *argv]


class Space(Namespace):
    """Network namespace without a file: the kernel removes it with its last user, however this process ends.

    A context manager, which enters it with this thread and closes it at the end. It has no IPv6, so that all frames are
    ours. Raises ``OSError``: not allowed here.
    """

    def __init__(self) -> None:
        def make() -> int:
            """Move the present thread, which ends soon, into a new namespace."""
            if _LIBC.unshare(netns.CLONE_NEWNET):
                raise OSError(number := ctypes.get_errno(), os.strerror(number))
            Path("/proc/sys/net/ipv6/conf/default/disable_ipv6").write_text("1", encoding="ascii")
            return os.open(_HERE, os.O_RDONLY | os.O_CLOEXEC)

        self._descriptor = netns_files.inside(Path(_HERE), make)
        self.path = Path(f"/proc/{os.getpid()}/fd/{self._descriptor}")
        self._entries = contextlib.ExitStack()

    def __enter__(self: _SpaceT) -> _SpaceT:
        self._entries.enter_context(self.entered())
        return self

    def __exit__(self, *_: object) -> None:
        self._entries.close()
        self.close()

    def close(self) -> None:
        """Leave the namespace to the kernel; its processes and sockets keep it."""
        os.close(self._descriptor)

    def ip(self, *words: str) -> str:
        """Run ``ip`` inside, and return what it prints. Raises ``subprocess.CalledProcessError``: it refuses."""
        with self.entered():
            return subprocess.run(["ip", *words], check=True, capture_output=True, text=True).stdout

    def set(self, setting: str, value: str) -> None:
        """Set a value below ``/proc/sys/net`` of the namespace."""
        with self.entered():
            Path("/proc/sys/net", setting).write_text(value, encoding="ascii")

    def veth(self, one: str, other: str, one_mac: bytes, other_mac: bytes, mtu: int = 1500) -> None:
        """Create a pair of joined devices; return when both are up."""
        ends = ("mtu", str(mtu), "address", one_mac.hex(":")), ("mtu", str(mtu), "address", other_mac.hex(":"))
        self.ip("link", "add", one, *ends[0], "type", "veth", "peer", "name", other, *ends[1])
        for name in (one, other):
            self.ip("link", "set", name, "up")
        self.inside(partial(wait_for_carrier, one, other))

    def connect(self, other: Space, device: str, far: str = "") -> None:
        """Join this namespace by ``device`` to the device ``far`` of another, by default of the same name."""
        place = ("netns", str(other.path))
        self.ip("link", "add", device, "type", "veth", "peer", "name", far or device, *place)
        other.ip("link", "set", far or device, "up")
        self.ip("link", "set", device, "up")
        self.inside(partial(wait_for_carrier, device))


@contextlib.contextmanager
def cable(here: Space) -> Iterator[Space]:
    """Join a namespace to a new one by ``eth0``; yield the new one, whose loopback is up like that of ``here``."""
    with contextlib.closing(Space()) as there:
        for each in (here, there):
            each.ip("link", "set", "lo", "up")
        here.connect(there, "eth0")
        yield there


def wait_for_carrier(*devices: str) -> None:
    """Return when these devices of the thread's namespace can send. Raises ``LocalError``: they do not get so far."""
    with contextlib.closing(LinkMonitor()) as monitor:
        while not all(link is not None and link.up for link in map(monitor.get, devices)):
            if not select.select([monitor], [], [], _PATIENCE_S)[0]:
                raise LocalError(f"no carrier at {', '.join(devices)}")
            monitor.poll()


_MAC_PREFIX: Final = "02:67:64:70"  # locally administered; "gdp" in ASCII
_LOOPBACK: Final = 1  # the index of lo in every namespace
_INDEX_FROM: Final = 100
_PLUG_FROM: Final = 10_000


class Namespaces:
    """The namespaces of one run. ``run.end()`` removes exactly these, and with them every device inside.

    Raises ``LocalError``: the kernel refuses; the run's record names what was made before.
    """

    def __init__(self, topology: Topology, run: Run) -> None:
        self.topology = topology
        self._plugged = 0
        self._namespaces = {node: Namespace(run, node) for node in topology.nodes}
        for namespace in self._namespaces.values():
            namespace.inside(netns_files.disable_ipv6)
        self._join()
        for node in topology.nodes:
            self._inside(node, partial(_raise, [link.other(node) for link in topology.links_of(node)]))

    def __getitem__(self, node: str) -> Namespace:
        """Return the namespace of a switch."""
        return self._namespaces[node]

    def cut(self, a: str, b: str) -> None:
        """Take the link between two switches down; both ends lose their carrier at once."""
        self._set_link(a, b, "down")

    def restore_link(self, a: str, b: str) -> None:
        """Bring a cut link back up."""
        self._set_link(a, b, "up")

    def connect_device(self, home: str, ifname: str, switch: str) -> None:
        """Connect device ``ifname`` in one switch's namespace to a new ``ifname-s`` in another's, or its own."""
        self._plugged += 1
        mtu = max(link.mtu for link in self.topology.links)
        far = os.open(self[switch].path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            self._inside(home, partial(_plug, ifname, mtu, _PLUG_FROM + self._plugged, far))
        finally:
            os.close(far)
        self._inside(switch, partial(_set_state, f"{ifname}-s", "up"))
        self._inside(home, partial(_set_state, ifname, "up"))

    def unplug(self, home: str, ifname: str) -> None:
        """Remove the pair that ``plug`` made."""
        self._inside(home, partial(_delete, ifname))

    def _set_link(self, a: str, b: str, state: str) -> None:
        link = self.topology.link(a, b)
        self._inside(link.a, partial(_set_state, link.b, state))

    def _join(self) -> None:
        number = {node: index for index, node in enumerate(self.topology.nodes, 1)}
        files = {node: os.open(each.path, os.O_RDONLY | os.O_CLOEXEC) for node, each in self._namespaces.items()}
        try:
            # The request may come from any namespace; in one of ours, no device name of the machine can clash.
            self._inside(self.topology.nodes[0], partial(_add, self.topology.links, number, files))
        finally:
            for descriptor in files.values():
                os.close(descriptor)

    def _inside(self, node: str, work: Callable[[IPRoute], object]) -> None:
        def ask() -> None:
            """Do the work with a netlink socket in the namespace."""
            with IPRoute() as ipr:
                work(ipr)

        try:
            self[node].inside(ask)
        except Exception as error:  # pyroute2 raises NetlinkError, which is not an OSError
            raise LocalError(f"namespace of {node}: {error}") from error


def _add(links: Sequence[Link], number: dict[str, int], files: dict[str, int], ipr: IPRoute) -> None:
    """Make the veth pairs, whose two ends must not share an index.

    With equal indices, Linux may report a lost carrier up to a second late. Source: Linux, net/core/link_watch.c,
    ``linkwatch_urgent_event``. The kernel chooses the far end's index, and counts from 2.
    """
    for index, link in enumerate(links, _INDEX_FROM):
        a, b = number[link.a], number[link.b]
        own = {"ifname": link.b, "mtu": link.mtu, "address": _mac(a, b), "net_ns_fd": files[link.a]}
        peer = {"ifname": link.a, "mtu": link.mtu, "address": _mac(b, a), "net_ns_fd": files[link.b]}
        ipr.link("add", kind="veth", index=index, peer=peer, **own)


def _plug(ifname: str, mtu: int, index: int, far: int, ipr: IPRoute) -> None:
    peer = {"ifname": f"{ifname}-s", "mtu": mtu, "net_ns_fd": far}
    ipr.link("add", kind="veth", ifname=ifname, mtu=mtu, index=index, peer=peer)


def _delete(ifname: str, ipr: IPRoute) -> None:
    ipr.link("del", index=ipr.link_lookup(ifname=ifname)[0])


def _mac(own: int, other: int) -> str:
    return f"{_MAC_PREFIX}:{own:02x}:{other:02x}"


def _raise(devices: Sequence[str], ipr: IPRoute) -> None:
    ipr.link("set", index=_LOOPBACK, state="up")
    for device in devices:
        _set_state(device, "up", ipr)


def _set_state(device: str, state: str, ipr: IPRoute) -> None:
    ipr.link("set", index=ipr.link_lookup(ifname=device)[0], state=state)
