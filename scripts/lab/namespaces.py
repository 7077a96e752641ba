"""Kernel namespaces, and the realisation of a topology: one namespace per switch, one veth pair per link.

I/O; needs root of the machine or of a user namespace.
Devices of a topology have no addresses and no IPv6: all traffic on them is ours. On every end the device has the name
of the neighbour that it leads to. Its MAC encodes both switches (``02:67:64:70:AA:BB``, the AA-th towards the BB-th).
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import select
import socket
import struct
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

from pyroute2 import IPRoute, netns
from pyroute2.netlink.exceptions import NetlinkError

from gdp.errors import LocalError
from gdp.host import netns_files
from gdp.host.run_registry import Run, in_first_user_namespace
from gdp.ports.rtnetlink import LinkMonitor
from lab.topology import Topology

_PATIENCE_S: Final = 10.0
_HERE: Final = "/proc/thread-self/ns/net"
_NET: Final = Path("/proc/sys/net")
_SETTINGS: Final = {  # no address waits for duplicate detection, and none is lost with the carrier
    "ipv4/conf/all/send_redirects": 0,
    "ipv4/conf/default/send_redirects": 0,
    "ipv6/conf/default/accept_dad": 0,
    "ipv6/conf/default/accept_ra": 0,
    "ipv6/conf/default/router_solicitations": 0,
    "ipv6/conf/all/keep_addr_on_down": 1,
    "ipv6/conf/default/keep_addr_on_down": 1,
}
_FORWARDING: Final = {"ipv4/ip_forward": 1, "ipv6/conf/all/forwarding": 1}
_NO_BRIDGE_RULES: Final = {"bridge/bridge-nf-call-iptables": 0, "bridge/bridge-nf-call-ip6tables": 0}
_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_SIOCETHTOOL: Final = 0x8946
_OFFLOADS: Final = (0x1F, 0x24, 0x2C, 0x17)  # to set tso, gso, gro, tx-checksum: segmentation needs checksums

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
        """Call ``work`` in a thread inside, and return its result; a socket made there stays there.

        Raises ``LocalError``: the kernel refuses a request of netlink.
        """
        try:
            return netns_files.inside(self.path, work)
        except NetlinkError as error:
            raise LocalError(f"{self.path.name}: {error}") from error

    def join(self, far: Namespace, device: str, far_device: str) -> None:
        """Make a pair of devices, one here and one in a far namespace; either may have more words of ip-link(8)."""
        self.configure([f"link add dev {device} type veth peer name {far_device} netns {far.path}"])

    def move(self, device: str, to: Namespace) -> None:
        """Move a device to another namespace, where it is down."""
        self.configure([f"link set dev {device} netns {to.path}"])

    def bridge(self, name: str, devices: Iterable[str] = ()) -> None:
        """Join devices by a new bridge without spanning tree."""
        made = f"link add dev {name} type bridge stp_state 0 forward_delay 0"
        self.configure([made, *(f"link set dev {each} master {name}" for each in devices), f"link set dev {name} up"])

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

    def run(self, *argv: str, text: str = "") -> str:
        """Run a command inside, with ``text`` as its input; return what it prints. Raises ``LocalError``: it fails."""
        run = partial(subprocess.run, argv, input=text, capture_output=True, check=False, text=True)
        done: subprocess.CompletedProcess[str] = self.inside(run)
        if done.returncode:
            raise LocalError(f"{self.path.name}: {' '.join(argv)}: {done.stderr.strip()}\n{text}")
        return done.stdout

    def ip(self, *words: str) -> str:
        """Run ``ip`` inside, and return what it prints. Raises ``LocalError``: it refuses."""
        return self.run("ip", *words)

    def configure(self, lines: Iterable[str]) -> None:
        """Execute commands of ip(8), each without the word ``ip``. Raises ``LocalError``: one is refused."""
        self.run("ip", "-batch", "-", text="\n".join(lines))

    def nft(self, text: str) -> None:
        """Execute commands of nft(8) as one transaction. Raises ``LocalError``: it is refused."""
        self.run("nft", "-f", "-", text=text)

    def set(self, setting: str, value: object) -> None:
        """Set a value below ``/proc/sys/net`` of the namespace."""
        self.inside(lambda: (_NET / setting).write_text(str(value), encoding="ascii"))

    def wait_for_carrier(self, *devices: str) -> None:
        """Return when these devices can send. Raises ``LocalError``: they do not get so far."""
        self.inside(partial(wait_for_carrier, *devices))

    def command(self, argv: Sequence[str], *, dies_with_us: bool = True) -> list[str]:
        """Return the command line that runs ``argv`` inside, under the same process id.

        ``dies_with_us``: whether the kernel kills it when the thread that starts it ends in any way.
        """
        leash = ["setpriv", "--pdeathsig", "KILL", "--"] if dies_with_us else []
        return ["nsenter", f"--net={self.path}", "--", *leash, *argv]


class IpNamespace(Namespace):
    """A namespace of a run with both versions of IP, whose loopback is up. ``forwards``: whether it is a router."""

    def __init__(self, run: Run, label: str, *, forwards: bool = False) -> None:
        super().__init__(run, label)
        has_bridges = (_NET / "bridge").exists()  # else br_netfilter is not loaded, and bridged packets meet no rule
        settings = _SETTINGS | (_FORWARDING if forwards else {}) | (_NO_BRIDGE_RULES if has_bridges else {})
        for setting, value in settings.items():
            self.set(setting, value)
        self.ip("link", "set", "lo", "up")

    def flush_connections(self) -> None:
        """Forget the connections that the namespace tracks, and with them their NAT mappings."""
        self.run("conntrack", "-F")


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

    def veth(self, one: str, other: str, one_mac: bytes, other_mac: bytes, mtu: int = 1500) -> None:
        """Create a pair of joined devices; return when both are up."""
        end, peer = (f"mtu {mtu} address {mac.hex(':')}" for mac in (one_mac, other_mac))
        up = (f"link set {name} up" for name in (one, other))
        self.configure((f"link add {one} {end} type veth peer name {other} {peer}", *up))
        self.wait_for_carrier(one, other)

    def connect(self, other: Space, device: str, far: str = "") -> None:
        """Join this namespace by ``device`` to the device ``far`` of another, by default of the same name."""
        place = ("netns", str(other.path))
        self.ip("link", "add", device, "type", "veth", "peer", "name", far or device, *place)
        other.ip("link", "set", far or device, "up")
        self.ip("link", "set", device, "up")
        self.wait_for_carrier(device)


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
        for node, namespace in self._namespaces.items():
            namespace.configure(f"link set dev {device} up" for device in ("lo", *topology.neighbours(node)))

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
        own, peer = f"{ifname} index {_PLUG_FROM + self._plugged} mtu {mtu}", f"{ifname}-s mtu {mtu}"
        self[home].join(self[switch], own, peer)
        self[switch].configure([f"link set dev {ifname}-s up"])
        self[home].configure([f"link set dev {ifname} up"])

    def unplug(self, home: str, ifname: str) -> None:
        """Remove the pair that ``plug`` made."""
        self[home].configure([f"link del dev {ifname}"])

    def _set_link(self, a: str, b: str, state: str) -> None:
        link = self.topology.link(a, b)
        self[link.a].configure([f"link set dev {link.b} {state}"])

    def _join(self) -> None:
        """Make the veth pairs, whose two ends must not share an index.

        With equal indices, Linux may report a lost carrier up to a second late. Source: Linux, net/core/link_watch.c,
        ``linkwatch_urgent_event``. The kernel chooses the far end's index, and counts from 2.
        """
        number = {node: index for index, node in enumerate(self.topology.nodes, 1)}
        for index, link in enumerate(self.topology.links, _INDEX_FROM):
            a, b = number[link.a], number[link.b]
            own = f"{link.b} index {index} address {_mac(a, b)} mtu {link.mtu}"
            self[link.a].join(self[link.b], own, f"{link.a} address {_mac(b, a)} mtu {link.mtu}")


def _mac(own: int, other: int) -> str:
    return f"{_MAC_PREFIX}:{own:02x}:{other:02x}"


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


def clear_offloads(ifname: str) -> None:
    """Switch segmentation, reception and checksum offloads off, so that a frame on the wire is a frame of a program.

    It applies to the namespace of the calling thread, by the old one-word requests: the command ``ethtool`` and its
    netlink family are often absent. Raises ``OSError``: no such device, or not allowed.
    Source: ``linux/ethtool.h``, ``linux/sockios.h``, netdevice(7).
    """
    for command in _OFFLOADS:
        request = ctypes.create_string_buffer(struct.pack("=II", command, 0), 8)
        argument = struct.pack("16sP16x", ifname.encode(), ctypes.addressof(request))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
            fcntl.ioctl(asked, _SIOCETHTOOL, argument)
