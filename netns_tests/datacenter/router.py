"""Router of a data centre: a private network, one-to-one NAT, and the firewall of security groups.

I/O; a network namespace of the run, reached from the namespace of the caller by a veth pair. Like EC2's internet
gateway, it gives each machine a public address; it admits what the machine's security groups admit, and replies.
::

    caller 198.51.100.1 ==== wan 198.51.100.2 [router] lan 10.77.0.1 ==== machines 10.77.0.10, ...
                                              169.254.169.254: metadata
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Final

from gdp.host.run_registry import Run
from internet.space import Space
from lab.namespaces import Namespace

CALLER: Final = IPv4Address("198.51.100.1")
METADATA: Final = IPv4Address("169.254.169.254")
_WAN: Final = IPv4Address("198.51.100.2")
_PUBLIC: Final = IPv4Address("198.51.100.0")
_LAN: Final = IPv4Address("10.77.0.1")
_PRIVATE: Final = IPv4Address("10.77.0.0")
_FIRST: Final = 10
_PATIENCE_S: Final = 20.0
_RULES: Final = """
table ip cloud {
  map to_private { type ipv4_addr : ipv4_addr; }
  map to_public { type ipv4_addr : ipv4_addr; }
  set admitted { type ipv4_addr . inet_proto . inet_service . ipv4_addr; }
  chain in { type nat hook prerouting priority dstnat; iifname "wan" dnat to ip daddr map @to_private; }
  chain out { type nat hook postrouting priority srcnat; oifname "wan" snat to ip saddr map @to_public; }
  chain forward {
    type filter hook forward priority filter; policy drop;
    ct state established,related accept
    iifname "lan" accept
    ip daddr . meta l4proto . th dport . ip saddr @admitted accept
  }
}
"""


@dataclass(frozen=True, slots=True)
class Lease:
    """Addresses of a machine, and its network namespace."""

    namespace: Namespace
    private: IPv4Address
    public: IPv4Address

    @property
    def network_config(self) -> str:
        """Return cloud-init's network configuration of the machine; a data centre without DHCP states it."""
        return (
            "network:\n  version: 2\n  ethernets:\n    eth0:\n"
            f"      addresses: [{self.private}/16]\n      gateway4: {_LAN}\n"
        )


@dataclass(frozen=True, slots=True)
class Admitted:
    """What a security group admits: one port of a protocol from one address."""

    protocol: str
    port: int
    source: IPv4Address


class Router:
    """Router of a run; ``Run.end`` removes it. The caller's end of the link is the device ``device``."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._next = _FIRST
        self.namespace = Space(run, "router", forwards=True)
        self.device = f"wan{run.id}"
        link = ("type", "veth", "peer", "name", "wan", "netns", str(self.namespace.path))
        _run("ip", "link", "add", self.device, *link)
        _run("ip", "address", "add", f"{CALLER}/24", "dev", self.device)
        _run("ip", "link", "set", self.device, "up")
        self.namespace.ip(
            [
                f"address add {_WAN}/24 dev wan",
                "link set wan up",
                f"address add {METADATA}/32 dev lo",
                "link add lan type bridge",
                f"address add {_LAN}/16 dev lan",
                "link set lan up",
            ]
        )
        self.namespace.nft(_RULES)

    def add(self, name: str, admitted: Iterable[Admitted] = ()) -> Lease:
        """Return the namespace and addresses of a new machine whose device ``eth0`` is up."""
        number, self._next = self._next, self._next + 1
        lease = Lease(Namespace(self._run, name), _PRIVATE + number, _PUBLIC + number)
        self.namespace.ip(
            [
                f"link add m{number} type veth peer name eth0 netns {lease.namespace.path}",
                f"link set m{number} master lan up",
                f"address add {lease.public}/32 dev wan",
            ]
        )
        rules = [
            f"add element ip cloud to_private {{ {lease.public} : {lease.private} }}",
            f"add element ip cloud to_public {{ {lease.private} : {lease.public} }}",
            *(
                f"add element ip cloud admitted {{ {lease.private} . {each.protocol} . {each.port} . {each.source} }}"
                for each in admitted
            ),
        ]
        self.namespace.nft("\n".join(rules))
        return lease


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"
