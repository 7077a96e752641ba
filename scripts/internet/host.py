"""Host of a laboratory: devices that are attached to sites, moved between them and unplugged.

I/O. A device stays while its host moves to another site: it loses its carrier, and gets another address.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from pyroute2 import IPRoute
from pyroute2.netlink.exceptions import NetlinkError

from gdp.errors import LocalError
from internet.access import LAN
from internet.site import Lease, Site
from lab.machine import LabMachine
from lab.namespaces import IpNamespace

_IFA_F_NODAD: Final = 0x02
_PERMANENT: Final = 0x80  # NUD_PERMANENT: of a state that no flush removes
_NOARP: Final = 0x40


def change_lease(device: str, old: Lease, new: Lease, metric: int) -> None:
    """Replace the addresses and default routes of a device, and forget its neighbours.

    ``metric``: of the default routes. Raises ``LocalError``: the kernel refuses.
    """
    try:
        with IPRoute() as netlink:
            index = socket.if_nametoindex(device)
            for address, gateway in _pairs(old):
                netlink.route("del", **_route(gateway, index, metric))
                netlink.addr("del", index=index, **_address(address))
            for each in list(netlink.get_neighbours(ifindex=index)):
                if not each["state"] & (_PERMANENT | _NOARP):
                    netlink.neigh("del", ifindex=index, family=each["family"], dst=each.get_attr("NDA_DST"))
            for address, gateway in _pairs(new):
                netlink.addr("add", index=index, flags=_IFA_F_NODAD if ":" in address else 0, **_address(address))
                netlink.route("add", **_route(gateway, index, metric))
    except (NetlinkError, OSError) as error:
        raise LocalError(f"the addresses of {device} are not changed: {error}") from error


def _pairs(lease: Lease) -> list[tuple[str, str]]:
    both = ((lease.address, lease.gateway), (lease.address6, lease.gateway6))
    return [(address, gateway) for address, gateway in both if address]


def _address(text: str) -> dict[str, object]:
    address, _, bits = text.partition("/")
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    return {"address": str(ipaddress.ip_address(address)), "prefixlen": int(bits), "family": family}


def _route(gateway: str, index: int, metric: int) -> dict[str, object]:
    family = socket.AF_INET6 if ":" in gateway else socket.AF_INET
    return {"dst": "default", "gateway": gateway, "oif": index, "priority": metric, "family": family}


if TYPE_CHECKING:
    from internet.laboratory import Laboratory

ETHERNET: Final = "eth0"
_FIRST_METRIC: Final = 100


@dataclass(slots=True)
class _Attachment:
    site: Site
    number: int  # of the host at the site
    port: str  # device of the site's router
    metric: int
    lease: Lease = field(default_factory=Lease)


class Host(LabMachine):
    """A machine; ``Laboratory.add_host`` makes it."""

    def __init__(self, laboratory: Laboratory, label: str) -> None:
        self.label = label
        self.laboratory = laboratory
        self.space = IpNamespace(laboratory.run, label)
        super().__init__(laboratory.run.directory, self.space.command([]), run=laboratory.run)
        self._attachments: dict[str, _Attachment] = {}

    @property
    def devices(self) -> list[str]:
        """The devices, in the order in which they came."""
        return list(self._attachments)

    def attach(self, site: Site, device: str = ETHERNET) -> None:
        """Connect a device with a site, a new one if there is none of that name; away from its former site.

        The default route over the device that came first is the best.
        """
        router = site.routers[0]
        attachment = self._attachments.get(device)
        if attachment is None:
            port = self.laboratory.next_device()
            metric = _FIRST_METRIC * (1 + len(self._attachments))
            link = f"link add {device} index {self.laboratory.next_index()} type veth peer {port} netns {router.path}"
            self.space.configure([link, f"link set {device} up"])
            attachment = self._attachments[device] = _Attachment(site, site.next_host(), port, metric)
        else:
            attachment.site.routers[0].configure([f"link set {attachment.port} netns {router.path}"])
            attachment.site, attachment.number = site, site.next_host()
        router.configure([f"link set {attachment.port} master {LAN} up"])
        self._wait_for_carrier(device)
        self.renew_lease(device)

    def renew_lease(self, device: str = ETHERNET) -> None:
        """Give a device the addresses and routes that its site has for it now."""
        attachment = self._attachments[device]
        old, new = attachment.lease, attachment.site.lease(attachment.number)
        self.space.inside(lambda: change_lease(device, old, new, attachment.metric))
        attachment.lease = new

    def renumber(self, device: str = ETHERNET) -> None:
        """Give a device another address of its site, as a DHCP server does."""
        attachment = self._attachments[device]
        attachment.number = attachment.site.next_host()
        self.renew_lease(device)

    def unplug(self, device: str = ETHERNET) -> None:
        """Take the carrier away from a device; its addresses stay."""
        self._set_port(device, "down")

    def plug(self, device: str = ETHERNET) -> None:
        """Give an unplugged device its carrier back."""
        self._set_port(device, "up")
        self._wait_for_carrier(device)
        self.space.configure([f"neigh flush dev {device}"])  # a request from before is repeated after a second only

    def lease(self, device: str = ETHERNET) -> Lease:
        """Return the addresses of a device."""
        return self._attachments[device].lease

    def site(self, device: str = ETHERNET) -> Site:
        """Return the site that a device is attached to."""
        return self._attachments[device].site

    def devices_at(self, site: Site) -> list[str]:
        """Return the devices that are attached to a site."""
        return [device for device, each in self._attachments.items() if each.site is site]

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` on the host, as ``Space.command``."""
        return self.space.command(argv)

    def _set_port(self, device: str, state: str) -> None:
        attachment = self._attachments[device]
        attachment.site.routers[0].configure([f"link set {attachment.port} {state}"])

    def _wait_for_carrier(self, device: str) -> None:
        """Return when no frame is lost in either direction: an address request that is lost costs a second."""
        attachment = self._attachments[device]
        attachment.site.routers[0].wait_for_carrier(attachment.port, LAN)
        self.space.wait_for_carrier(device)
