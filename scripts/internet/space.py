"""Network namespace of a laboratory: commands of ip(8), nft(8) and conntrack(8) inside it. I/O; needs CAP_NET_ADMIN."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.namespaces import Namespace, wait_for_carrier

TOOLS: Final = ("ip", "nft", "conntrack")

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


class Space(Namespace):
    """A namespace of a run, whose loopback is up.

    ``label``: part of its name; unique in the run. ``forwards``: whether it is a router. Raises ``LocalError``: the
    kernel refuses.
    """

    def __init__(self, run: Run, label: str, *, forwards: bool = False) -> None:
        super().__init__(run, label)
        self.set(_SETTINGS | (_FORWARDING if forwards else {}))
        if (_NET / "bridge").exists():  # else br_netfilter is not loaded, and bridged packets meet no rule
            self.set(_NO_BRIDGE_RULES)
        self.ip(["link set lo up"])

    def ip(self, lines: Iterable[str]) -> None:
        """Execute commands of ip(8), each without the word ``ip``. Raises ``LocalError``: one is refused."""
        self._run(["ip", "-batch", "-"], "\n".join(lines))

    def nft(self, text: str) -> None:
        """Execute commands of nft(8) as one transaction. Raises ``LocalError``: it is refused."""
        self._run(["nft", "-f", "-"], text)

    def wait_for_carrier(self, *devices: str) -> None:
        """Return when these devices can send. Raises ``LocalError``: they do not get so far."""
        self.inside(partial(wait_for_carrier, *devices))

    def flush_connections(self) -> None:
        """Forget the connections that the namespace tracks, and with them their NAT mappings."""
        self._run(["conntrack", "-F"])

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
