"""Site of a laboratory: one router, or two for a double NAT, between its hosts and the core.

I/O. ::

    hosts ---- lan [home router] wan ---- lan [carrier's router] wan ---- uplink [core]
                                          only for a double NAT           |
                                                       a delay line of two devices, where asked for

Links between routers and the core have link-local addresses only, and each end knows the other's MAC address, as on a
point-to-point link: a lost ARP request would be repeated after a second. A site of public access owns a block of eight
addresses. Behind a NAT the outermost router has one, and all sites use the same private addresses. An IPv6 site has
a prefix of 48 bits.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import cached_property, partial
from ipaddress import IPv4Network
from typing import TYPE_CHECKING, Final

from lab.internet.access import FLUSH_MAPPINGS, LAN, TRAITS, WAN, Access, router_rules
from lab.machines import DELAY_LINE
from lab.namespaces import IpNamespace, clear_offloads
from lab.process import LabProcess

if TYPE_CHECKING:
    from lab.internet.laboratory import Laboratory

_CORE_END, _ROUTER_END = "169.254.0.1", "169.254.0.2"  # RFC 3927, on every link towards the core
_CORE_END6, _ROUTER_END6 = "fe80::1", "fe80::2"
_CORE_ENDS, _ROUTER_ENDS = (_CORE_END, _CORE_END6), (_ROUTER_END, _ROUTER_END6)
_HOME: Final = IPv4Network("192.168.1.0/24")
_CARRIER: Final = IPv4Network("100.64.0.0/24")  # RFC 6598
_MAC: Final = b"\x02gdp"  # fixed, because a bridge otherwise takes the address of one of its ports
_FIRST_HOST: Final = 10


@dataclass(frozen=True, slots=True)
class Lease:
    """Configuration that a host of the site gets: addresses with prefix length, gateways; empty: none."""

    address: str = ""
    gateway: str = ""
    address6: str = ""
    gateway6: str = ""

    def pairs(self) -> list[tuple[str, str]]:
        """Return each address with its gateway."""
        both = ((self.address, self.gateway), (self.address6, self.gateway6))
        return [(address, gateway) for address, gateway in both if address]

    def has(self, version: int) -> bool:
        """Return whether there is an address of this IP version."""
        return bool(self.address if version == 4 else self.address6)


class Site:
    """Access of some hosts to the core; ``Laboratory.add_site`` makes it.

    ``access``: its kind. ``routers``: from its hosts outwards.
    """

    def __init__(self, laboratory: Laboratory, label: str, access: Access, delay_ms: float) -> None:
        self.label, self.access = label, access
        self._laboratory = laboratory
        self._core = laboratory.core
        self.is_cut = False
        self.uplink = laboratory.next_device()  # the core's device
        self._leases = 0
        self._line: LabProcess | None = None
        count = 2 if access is Access.DOUBLE_NAT else 1
        self.routers = tuple(
            IpNamespace(laboratory.run, f"{label}-{name}", forwards=True) for name in ("router", "carrier")[:count]
        )
        self._block, self._prefix = laboratory.take_block(), laboratory.take_prefix()
        self._core_mac, self._wan_mac = self._next_mac(), self._next_mac()
        for router in self.routers:
            bridge = f"{LAN} address {self._next_mac()} type bridge forward_delay 0 mcast_snooping 0"
            router.configure([f"link add {bridge}", f"link set {LAN} up"])
        if count == 2:
            home, carrier = self.routers
            port = laboratory.next_device()
            carrier.configure(
                [f"link add {port} index {laboratory.next_index()} type veth peer {WAN} netns {home.path}"]
            )
            carrier.configure([f"link set {port} master {LAN} up"])
        self._join_core(delay_ms)
        self._configure()

    @property
    def address(self) -> str:
        """The public IPv4 address of the NAT; empty: there is no NAT."""
        return str(self._block[1]) if self._is_nat else ""

    @property
    def _is_nat(self) -> bool:
        return self.access is not Access.PUBLIC and self._has4

    @cached_property
    def _has4(self) -> bool:
        return 4 in TRAITS[self.access].versions

    @cached_property
    def _has6(self) -> bool:
        return 6 in TRAITS[self.access].versions

    @property
    def _outer(self) -> IpNamespace:
        return self.routers[-1]

    def lease(self, number: int) -> Lease:
        """Return the configuration of the host with this number, from 0 on, under the site's current addresses."""
        lan = self._lan
        own = lan[2 + number] if self.access is Access.PUBLIC else lan[_FIRST_HOST + number]
        lease = Lease(f"{own}/{lan.prefixlen}", str(lan[1])) if self._has4 else Lease()
        if not self._has6:
            return lease
        return replace(lease, address6=f"{self._prefix[_FIRST_HOST + number]}/64", gateway6=_CORE_END6)

    def next_host(self) -> int:
        """Return the number of one more host."""
        self._leases += 1
        return self._leases - 1

    def renumber(self) -> None:
        """Give the site other public addresses, as a provider does: its hosts' too, where these are public."""
        old, old_prefix, old_lan = self._block, self._prefix, self._lan
        self._block, self._prefix = self._laboratory.take_block(), self._laboratory.take_prefix()
        core, outer = [], []
        if self._has4:
            core.append(f"route del {old} dev {self.uplink}")
            if self.access is Access.PUBLIC:
                outer.append(f"addr del {old_lan[1]}/{old_lan.prefixlen} dev {LAN}")
            else:  # while the device is down, no packet takes another address, and the NAT forgets its mappings
                outer += [f"link set {WAN} down", f"addr del {old[1]}/32 dev {WAN}"]
        if self._has6:
            core.append(f"route del {old_prefix} dev {self.uplink}")
            outer.append(f"addr del {old_prefix[1]}/64 dev {LAN}")
        self._core.configure(core)
        self._outer.configure(outer)
        self._configure()
        if self._is_nat:
            self._outer.flush_connections()  # packets that came in between have a mapping to an inner address
        for host in self._laboratory.hosts.values():
            for device in host.devices_at(self):
                host.renew_lease(device)

    def cut(self) -> None:
        """Let all packets of the uplink vanish."""
        self.is_cut = True
        self._laboratory.apply_cuts()

    def restore(self) -> None:
        """End a cut."""
        self.is_cut = False
        self._laboratory.apply_cuts()

    def flush_mappings(self) -> None:
        """Let the NATs of the site forget their mappings; those that new datagrams make may have the same ports."""
        for router in self.routers:
            router.flush_connections()
            if self.access is not Access.PUBLIC:
                router.nft(FLUSH_MAPPINGS)

    def power_off(self) -> None:
        """Switch the routers off: all their links lose the carrier, and they forget their mappings."""
        self._laboratory.set_ports(self, is_up=False)
        for router in self.routers:
            router.configure([f"link set {WAN} down"])
        self.flush_mappings()

    def power_on(self) -> None:
        """Switch the routers on again, under the same addresses."""
        self._configure()
        self._laboratory.set_ports(self, is_up=True)

    def close(self) -> None:
        """End the process of the delay line."""
        if self._line is not None:
            self._line.close()

    def _next_mac(self) -> str:
        return (_MAC + self._laboratory.next_index().to_bytes(2, "big")).hex(":")

    def _join_core(self, delay_ms: float) -> None:
        number, outer = self._laboratory.next_index(), self._outer
        core_end, router_end = f"index {number} address {self._core_mac}", f"address {self._wan_mac} netns {outer.path}"
        if not delay_ms:
            self._core.configure([f"link add {self.uplink} {core_end} type veth peer name {WAN} {router_end}"])
            return
        line = IpNamespace(self._laboratory.run, f"{self.label}-line")
        self._core.configure([f"link add {self.uplink} {core_end} type veth peer core netns {line.path}"])
        outer.configure(
            [f"link add {WAN} index {number} address {self._wan_mac} type veth peer site netns {line.path}"]
        )
        for device in ("core", "site"):
            line.set(f"ipv6/conf/{device}/disable_ipv6", 1)
        line.configure(["link set core up", "link set site up"])
        self._core.inside(partial(clear_offloads, self.uplink))
        outer.inside(partial(clear_offloads, WAN))
        argv = line.command([sys.executable, *DELAY_LINE, "core", "site", str(delay_ms)])
        self._line = LabProcess(self._laboratory.run, f"line {self.label}", argv, has_orders=True)
        self._line.answer("go").read_until("ready")

    def _configure(self) -> None:
        """Set all links up, and addresses, routes and rules; harmless where they are so."""
        core = [
            f"link set {self.uplink} up",
            f"addr replace {_CORE_END}/32 dev {self.uplink} scope link",
            f"addr replace {_CORE_END6}/64 dev {self.uplink} nodad",
            *(f"neigh replace {end} lladdr {self._wan_mac} dev {self.uplink} nud permanent" for end in _ROUTER_ENDS),
        ]
        outer = [
            f"link set {WAN} up",
            f"addr replace {_ROUTER_END}/32 dev {WAN} scope link",
            f"addr replace {_ROUTER_END6}/64 dev {WAN} nodad",
            *(f"neigh replace {end} lladdr {self._core_mac} dev {WAN} nud permanent" for end in _CORE_ENDS),
        ]
        if self._has4:
            core.append(f"route replace {self._block} via {_ROUTER_END} dev {self.uplink} onlink")
            outer += [f"addr replace {self._block[1]}/32 dev {WAN}"] if self._is_nat else []
            outer.append(f"route replace default via {_CORE_END} dev {WAN} onlink")
        if self._has6:
            core.append(f"route replace {self._prefix} via {_ROUTER_END6} dev {self.uplink}")
            outer.append(f"route replace default via {_CORE_END6} dev {WAN}")
        self._core.configure(core)
        self._outer.configure(outer)
        if len(self.routers) == 2:
            self._outer.configure([f"addr replace {_CARRIER[1]}/{_CARRIER.prefixlen} dev {LAN}"])
            wan = f"addr replace {_CARRIER[2]}/{_CARRIER.prefixlen} dev {WAN}"
            self.routers[0].configure([f"link set {WAN} up", wan, f"route replace default via {_CARRIER[1]}"])
            self.routers[0].wait_for_carrier(WAN)
        self._core.wait_for_carrier(self.uplink)
        self._outer.wait_for_carrier(WAN)
        self._configure_lan()
        for router, address in zip(self.routers, self._wan_addresses, strict=True):
            if rules := router_rules(self.access, address):
                router.nft(rules)

    @property
    def _lan(self) -> IPv4Network:
        return self._block if self.access is Access.PUBLIC else _HOME

    @property
    def _wan_addresses(self) -> tuple[str, ...]:
        return (str(_CARRIER[2]), self.address) if len(self.routers) == 2 else (self.address,)

    def _configure_lan(self) -> None:
        lines = [f"addr replace {self._lan[1]}/{self._lan.prefixlen} dev {LAN}"] if self._has4 else []
        if self._has6:
            lines += [
                f"addr replace {_CORE_END6}/64 dev {LAN} nodad",
                f"addr replace {self._prefix[1]}/64 dev {LAN} nodad",
            ]
        self.routers[0].configure(lines)
