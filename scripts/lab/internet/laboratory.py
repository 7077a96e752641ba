"""Laboratory of networks: an internet's core in a namespace, sites around it, hosts at the sites.

I/O; needs root of the machine or of a user namespace, nft(8) and conntrack(8). ``run.end()``, or the next start after
a crash, removes everything. Addresses are those for documentation (RFC 5737, RFC 3849), used inside only.
"""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Network, IPv6Network
from itertools import chain, count
from typing import Final

from gdp.closing import ClosedOnExit
from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.internet.access import Access, core_rules
from lab.internet.host import ETHERNET, Host
from lab.internet.site import Site
from lab.namespaces import IpNamespace
from lab.process import end_processes

_PUBLIC: Final = (IPv4Network("198.51.100.0/24"), IPv4Network("203.0.113.0/24"), IPv4Network("192.0.2.0/24"))
_PUBLIC6: Final = IPv6Network("2001:db8::/32")
_END_S: Final = 10.0
_BLOCK_BITS, _PREFIX_BITS = 29, 48
TOOLS: Final = ("ip", "nft", "conntrack")  # what it needs
_FIRST_INDEX: Final = 1_000  # ends of a pair differ in index; see ``lab.namespaces``


class Laboratory(ClosedOnExit):
    """The core and what is attached to it; a context manager that ends the processes of hosts and of delay lines.

    Raises ``LocalError``: the kernel refuses; the run's record names what was made before.
    """

    def __init__(self, run: Run) -> None:
        self.run = run
        self.core = IpNamespace(run, "core", forwards=True)
        self.sites: dict[str, Site] = {}
        self.hosts: dict[str, Host] = {}
        self._blocks: Iterator[IPv4Network] = chain.from_iterable(
            zip(*(each.subnets(new_prefix=_BLOCK_BITS) for each in _PUBLIC), strict=True)
        )
        self._prefixes = _PUBLIC6.subnets(new_prefix=_PREFIX_BITS)
        self._indices, self._devices = count(_FIRST_INDEX), count()
        self.core.configure(f"route add blackhole {network}" for network in (*_PUBLIC, _PUBLIC6))

    def close(self) -> None:
        """End the processes."""
        end_processes([process for host in self.hosts.values() for process in host.running], _END_S)
        for each in self.sites.values():
            each.close()

    def add_site(self, label: str, access: Access, *, delay_ms: float = 0.0) -> Site:
        """Attach a site.

        ``label``: at most 10 letters, unique among sites and hosts. ``delay_ms``: of packets in each direction, whose
        order stays; it costs a process.
        """
        site = self.sites[label] = Site(self, label, access, delay_ms)
        return site

    def add_host(self, label: str, site: Site, device: str = ETHERNET) -> Host:
        """Attach a host to a site; more devices follow by ``Host.attach``."""
        host = self.hosts[label] = Host(self, label)
        host.attach(site, device)
        return host

    def next_index(self) -> int:
        """Return an interface index that no device of the laboratory has."""
        return next(self._indices)

    def next_device(self) -> str:
        """Return a device name that no device of the laboratory has."""
        return f"port{next(self._devices)}"

    def take_block(self) -> IPv4Network:
        """Return eight public addresses that no site had before. Raises ``LocalError``: none are left."""
        block = next(self._blocks, None)
        if block is None:
            raise LocalError("no public IPv4 address is left")
        return block

    def take_prefix(self) -> IPv6Network:
        """Return an IPv6 prefix that no site had before."""
        return next(self._prefixes)

    def set_ports(self, site: Site, *, is_up: bool) -> None:
        """Give the carrier to every host of a site, or take it away."""
        for host in self.hosts.values():
            for device in host.devices_at(site):
                (host.plug if is_up else host.unplug)(device)

    def apply_cuts(self) -> None:
        """Cut the uplinks of the sites that are to be cut, and no other."""
        self.core.nft(core_rules(site.uplink for site in self.sites.values() if site.is_cut))
