"""Network namespace of a laboratory: commands of ip(8), nft(8) and conntrack(8) inside it.

I/O; needs CAP_NET_ADMIN. The run's record names each namespace before it is made.
"""

from __future__ import annotations

import contextlib
import select
import subprocess
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, TypeVar

from gdp.errors import LocalError
from gdp.host import netns_files
from gdp.host.run_registry import Run, in_first_user_namespace
from gdp.ports.rtnetlink import LinkMonitor

__all__ = ["TOOLS", "Space"]

TOOLS: Final = ("ip", "nft", "conntrack", "tc")

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
_PATIENCE_S: Final = 10.0

T = TypeVar("T")


class Space:
    """A namespace of a run, whose loopback is up.

    Args:
        label: part of its name; unique in the run.
        forwards: whether it is a router.

    Raises:
        LocalError: the kernel refuses.
    """

    def __init__(self, run: Run, label: str, *, forwards: bool = False) -> None:
        folder = netns_files.IP_NETNS_DIRECTORY if in_first_user_namespace() else run.directory / "netns"
        self.path = folder / f"gdp-{run.id}-{label}"
        run.plan_namespace(self.path)
        netns_files.create(self.path)
        self.set(_SETTINGS | (_FORWARDING if forwards else {}))
        if (_NET / "bridge").exists():  # else br_netfilter is not loaded, and bridged packets meet no rule
            self.set(_NO_BRIDGE_RULES)
        self.ip(["link set lo up"])

    def inside(self, work: Callable[[], T]) -> T:
        """Call ``work`` in a thread inside, and return its result; a socket made there stays there."""
        return netns_files.inside(self.path, work)

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` inside; the kernel kills it with the thread that starts it."""
        return ["nsenter", f"--net={self.path}", "--", "setpriv", "--pdeathsig", "KILL", "--", *argv]

    def ip(self, lines: Iterable[str]) -> None:
        """Execute commands of ip(8), each without the word ``ip``. Raises ``LocalError``: one is refused."""
        self._run(["ip", "-batch", "-"], "\n".join(lines))

    def nft(self, text: str) -> None:
        """Execute commands of nft(8) as one transaction. Raises ``LocalError``: it is refused."""
        self._run(["nft", "-f", "-"], text)

    def wait_for_carrier(self, *devices: str) -> None:
        """Return when these devices can send. Raises ``LocalError``: they do not get so far."""

        def wait() -> None:
            with contextlib.closing(LinkMonitor()) as monitor:
                while not all(link is not None and link.up for link in map(monitor.get, devices)):
                    if not select.select([monitor], [], [], _PATIENCE_S)[0]:
                        raise LocalError(f"{self.path.name}: no carrier at {', '.join(devices)}")
                    monitor.poll()

        self.inside(wait)

    def flush_connections(self) -> None:
        """Forget the connections that the namespace tracks, and with them their NAT mappings."""
        self._run(["conntrack", "-F"])

    def shape(self, device: str, mbit: float) -> None:
        """Limit what leaves by a device, in Mbit/s; 0: unlimited."""
        if mbit:
            limit = f"rate {mbit}mbit burst 64k latency 50ms"
            self._run(["tc", "qdisc", "replace", "dev", device, "root", "tbf", *limit.split()])
        elif "tbf" in self._run(["tc", "qdisc", "show", "dev", device]):
            self._run(["tc", "qdisc", "del", "dev", device, "root"])

    def set(self, settings: dict[str, int]) -> None:
        """Set values below ``/proc/sys/net``."""

        def write() -> None:
            for name, value in settings.items():
                (_NET / name).write_text(str(value), encoding="ascii")

        self.inside(write)

    def _run(self, argv: list[str], text: str = "") -> str:
        def run() -> subprocess.CompletedProcess[str]:
            return subprocess.run(argv, input=text, capture_output=True, check=False, text=True)

        done = self.inside(run)
        if done.returncode:
            raise LocalError(f"{self.path.name}: {' '.join(argv)}: {done.stderr.strip()}\n{text}")
        return done.stdout
